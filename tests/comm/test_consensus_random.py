"""Compares consensus on random networks with an implementation in plain Python."""

import math
import random

import pytest
import torch
from scalar_consensus import ScalarConsensus, heading_term
from tensordict import TensorDict
from time_steps import communication, time_step
from torch import Tensor

from emberlink.comm.base import Communication
from emberlink.comm.consensus import Consensus, ConsensusConfig, HeadingConfig
from emberlink.envs import keys
from emberlink.envs.config import RadioConfig, WildfireConfig
from emberlink.envs.utils import counter_rng
from emberlink.envs.utils.counter_rng import Use

FORMS = ["folded_linear", "folded_exponential", "approach"]


@pytest.mark.parametrize("uavs", range(1, 17))
def test_random_networks_equal_plain_python(uavs):
    envs, steps = 20, 5
    dice = random.Random(uavs)
    any_fire, form = uavs % 2 == 0, FORMS[uavs % 3]
    config = ConsensusConfig(
        discoverer="any_fire" if any_fire else "new_fire",
        heading=HeadingConfig(form=form),
        agree=uavs % 5 != 2,
        follow="nearest" if uavs % 4 in (1, 2) else "best",
    )
    radio = RadioConfig(range=dice.choice([4.0, 7.0, 10.0]), loss=0.3 if uavs % 3 == 0 else 0.0)
    world = WildfireConfig(radio=radio)
    talk: Communication | None = None
    scalars = [
        ScalarConsensus(
            radio.range, any_fire=any_fire, agree=config.agree, nearest=config.follow == "nearest"
        )
        for _ in range(envs)
    ]
    low, high = torch.tensor(world.low), torch.tensor(world.high)
    generator = torch.Generator().manual_seed(uavs)

    def draw(*shape: int) -> Tensor:
        return torch.rand(envs, uavs, *shape, generator=generator)

    position, sees = low + draw(3) * (high - low), draw() < 0.3
    before: TensorDict | None = None
    followed = 0
    for step in range(steps):
        sees = torch.where(draw() < 0.75, sees, draw() < 0.3)  # so that streaks are long
        new = ((draw() * 9 + 1).long() * sees).masked_fill(draw() < 0.1, 0)
        now = time_step(
            position,
            new,
            (draw() * 3).long() * sees,
            centre=position[..., :2] + draw(2) - 0.5,
            old_centre=position[..., :2] + draw(2) - 0.5,
            hit_boundary=draw(3) < 0.1,
            step=step,
        )
        if talk is None or before is None:
            talk = communication(now, config, world)
            now = talk._reset(now, now)
        else:
            now = talk._step(before, now)
        unit = counter_rng.uniform(
            counter_rng.step_key(now[keys.RNG_KEY], now[keys.STEP], Use.MESSAGE_LOSS), uavs * uavs
        )
        lost = (unit < radio.loss).unflatten(-1, (uavs, uavs))
        for env in range(envs):
            scalars[env].lost = {tuple(pair) for pair in lost[env].nonzero().tolist()}
            was = None if before is None else before[env]
            followed += compare(scalars[env], now[env], was, config)
            compare_streaks(scalars[env], talk.module, env)
        before = now
        position = (position + 2 * draw(3) - 1).clamp(low, high)
    if uavs > 1:
        assert followed > 0


def compare(scalar: ScalarConsensus, now, before, config: ConsensusConfig) -> int:
    """Compares a time step of one environment with plain Python; returns the number of seekers."""
    position = [tuple(p) for p in now[keys.POSITION].tolist()]
    new, old = now[keys.NEW_FIRE].tolist(), now[keys.OLD_FIRE].tolist()
    follows = scalar.step(position, new, old, scalar.lost)
    assert now[keys.FOLLOWS].tolist() == follows
    target = now[keys.TARGET].tolist()
    for i, leader in enumerate(follows):
        if leader == i:
            centre = now[keys.NEW_CENTRE if new[i] else keys.OLD_CENTRE][i].tolist()
            assert target[i] == [*centre, position[i][2]]
        elif leader >= 0:
            assert tuple(target[i]) == position[leader]
    if before is not None:
        for i, reward in enumerate(now[keys.REWARD].flatten().tolist()):
            start = tuple(before[keys.POSITION][i].tolist())
            aim = tuple(before[keys.TARGET][i].tolist())
            term = heading_term(config.heading.form, start, position[i], aim)
            term *= not now[keys.HIT_BOUNDARY][i].any()
            assert reward == pytest.approx(term, abs=1e-4)
    return sum(leader not in (-1, i) for i, leader in enumerate(follows))


def compare_streaks(scalar: ScalarConsensus, module: Consensus, env: int) -> None:
    """Compares the track records of one environment with plain Python."""
    for i, score in enumerate(module.fire_score[env].tolist()):
        assert score == scalar.fire_score(i)
        assert module.altitude_sum[env, i] == pytest.approx(scalar.altitude_sum(i), abs=1e-12)


@pytest.mark.parametrize("delay", [0, 1, 3])
@pytest.mark.parametrize(
    ("most", "agree", "best"),
    [(10**6, True, True), (45, True, False), (20, False, True), (19, True, True)],
)
def test_late_records_equal_plain_python(delay, most, agree, best):
    """Discoverers' records, passed on one link a step, in one environment of 8 UAVs."""
    uavs, steps, generator = 8, 40, torch.Generator().manual_seed(delay)
    radio = RadioConfig(range=9.0, loss=0.2, delay=delay, bandwidth=most)
    config = ConsensusConfig(agree=agree, follow="best" if best else "nearest", wander=False)
    world, talk, before = WildfireConfig(radio=radio), None, None
    scalar = ScalarConsensus(9.0)
    newest, received = [{} for _ in range(uavs)], [{} for _ in range(uavs)]
    flying, followed = [], 0
    position, sees = torch.rand(1, uavs, 3, generator=generator) * 25 + 1, None
    for step in range(steps):
        drawn = torch.rand(2, 1, uavs, generator=generator)
        sees = drawn[0] < 0.3 if sees is None else torch.where(drawn[1] < 0.8, sees, drawn[0] < 0.3)
        position = position + torch.rand(1, uavs, 3, generator=generator) - 0.5
        now = time_step(position, (drawn[1] * 9).long() * sees, sees * 0, step=step)
        now.set(keys.ALIVE, torch.ones(1, uavs, dtype=torch.bool))
        if talk is None or before is None:
            talk = communication(now, config, world)
            now = talk._reset(now, now)
        else:
            now = talk._step(before, now)
        before, hears = now, now[keys.HEARS][0].tolist()
        places = [tuple(p) for p in now[keys.POSITION][0].tolist()]
        new = now[keys.NEW_FIRE][0].tolist()
        scalar.step(places, new, [0] * uavs)
        for i in range(uavs):
            says = dict(received[i]) if agree and not new[i] else {}
            if new[i]:
                says = {i: (step, places[i], scalar.rank(i))}
            ranked = sorted(says, key=lambda j, says=says: -says[j][2])
            said = {j: says[j] for j in ranked[: most // 20]}
            assert talk.module.said[0, i] == 20 * len(said)
            flying += [(step + delay, k, said) for k in range(uavs) if hears[k][i]]
        received = [{} for _ in range(uavs)]
        for _, hearer, said in (m for m in flying if m[0] == step):
            for j, record in said.items():
                newer = record[0] > newest[hearer].get(j, -1)
                if j != hearer and newer and record[0] > received[hearer].get(j, (-1,))[0]:
                    received[hearer][j] = record
        flying = [m for m in flying if m[0] > step]
        for i, records in enumerate(received):
            newest[i] |= {j: record[0] for j, record in records.items()}

            def worse(j, i=i, records=records, places=places):
                return -records[j][2] if best else math.dist(places[i], records[j][1])

            leader = i if new[i] else min(sorted(records), key=worse, default=-1)
            assert now[keys.FOLLOWS][0, i] == leader
            if leader not in (-1, i):
                followed += 1
                assert tuple(now[keys.TARGET][0, i].tolist()) == records[leader][1]
    assert followed > 10 or most == 19
