"""Tests the channel pair by pair and the exchange of maps message by message."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scalar_exchange import ScalarExchange

from emberlink.envs.config import RadioConfig, WildfireConfig
from emberlink.envs.keys import BYTES_SENT
from emberlink.envs.utils import counter_rng
from emberlink.envs.utils.counter_rng import Use
from emberlink.envs.world.coverage_map import View
from emberlink.envs.world.exchange import Exchange, cell_bytes
from emberlink.envs.world.knowledge import Knowledge
from emberlink.envs.world.radio import Channel, Late, budget
from emberlink.trainers import make_env

RADIO = {
    "range": st.sampled_from([0.0, 6.0, 12.0, math.inf]),
    "loss": st.sampled_from([0.0, 0.2, 0.8, 1.0]),
    "burst": st.sampled_from([1.0, 1.5, 8.0]),
    "fade": st.booleans(),
    "delay": st.integers(0, 5),
    "bandwidth": st.sampled_from([None, 0, 1, 7, 20, 64]),
    "shared": st.booleans(),
}
ENVS, UAVS = 2, 4


def draw(seed: int, *shape: int) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def pair(key: torch.Tensor, step: int, use: Use, radios: int, i: int, j: int) -> float:
    """Returns the number that decides whether radio i hears radio j."""
    drawn = counter_rng.step_key(key, torch.tensor(step), use)
    return counter_rng.uniform(drawn, radios**2)[i * radios + j].item()


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 99), based=st.booleans(), **RADIO)
def test_links_equal_those_of_each_pair_by_itself(seed, based, **radio):
    config = RadioConfig(**radio)
    world = WildfireConfig(num_uavs=UAVS, radio=config, base=(0.0, 9.0))
    channel, keys = Channel(world, ENVS, base=based), counter_rng.seed_keys(seed, ENVS)
    radios, bad = UAVS + based, {}
    position = draw(seed, 6, ENVS, UAVS, 3).double() * 12
    alive = draw(seed + 1, 6, ENVS, UAVS) < 0.9
    for step in range(6):
        at = torch.full((ENVS,), step)
        _, links = channel(position[step], keys, at, alive[step])
        assert links.equal(channel(position[step], keys, at, alive[step])[1])
        places = channel.places(position[step])
        for e in range(ENVS):
            for i in range(radios):
                for j in range(radios):
                    mine = {i, j} <= set(range(UAVS))
                    one, two = (Use.MESSAGE_LOSS, Use.MESSAGE_FADE) if mine else \
                        (Use.REPORT_LOSS, Use.REPORT_FADE)  # fmt: skip
                    side, loss = UAVS if mine else radios, config.loss
                    u = pair(keys[e], step, one, side, i, j)
                    ends = min(1 / config.burst, 1 - loss)
                    gets = loss * ends / (1 - loss) if loss < 1 else 1
                    was = bad.get((e, i, j), False)
                    bad[e, i, j] = u < loss if step == 0 else u < (1 - ends if was else gets)
                    far = math.dist(places[e, i].tolist(), places[e, j].tolist())
                    lives = all(k == UAVS or alive[step, e, k] for k in (i, j))
                    heard = i != j and far < config.range and lives and not bad[e, i, j]
                    if heard and config.fade:
                        chance = far**5 / (far**5 + (0.65 * config.range) ** 5)
                        heard = pair(keys[e], step, two, side, i, j) >= chance
                    assert links[e, i, j] == heard
    at = torch.arange(6).unsqueeze(-1).expand(6, ENVS)
    _, again = Channel(world, ENVS, base=based)(position, keys.expand(6, ENVS), at, alive)
    assert again[-1].equal(links)


@pytest.mark.parametrize(("loss", "burst", "length"), [(0.3, 20.0, 20), (0.3, 1.0, 1 / 0.7)])
def test_bad_spells_have_their_share_and_their_length(loss, burst, length):
    config = RadioConfig(range=math.inf, loss=loss, burst=burst)
    channel = Channel(WildfireConfig(num_uavs=12, radio=config), 40)
    steps, position = 400, torch.zeros(40, 12, 3).double()
    keys = counter_rng.seed_keys(0, 40)
    links = torch.stack([channel(position, keys, torch.full((40,), t))[1] for t in range(steps)])
    off = ~torch.eye(12, dtype=torch.bool)
    lost = ~links[:, :, off]
    assert lost.float().mean().item() == pytest.approx(loss, abs=0.01)
    ended = (lost[:-1] & ~lost[1:]).sum()
    assert (lost[:-1].sum() / ended).item() == pytest.approx(length, rel=0.06)


@given(
    delay=st.integers(0, 6),
    lengths=st.lists(st.integers(1, 9), min_size=1, max_size=4),
    together=st.booleans(),
)
def test_what_is_late_arrives_as_it_was_sent_and_in_its_episode(delay, lengths, together):
    late, sent = Late(delay, torch.tensor(-1), 1, 2), 1
    for length in lengths:
        late.start_episodes(torch.tensor([True]))
        said = torch.arange(sent, sent + length).view(-1, 1, 1) * torch.tensor([1, 2])
        sent += length
        arrives = late(said) if together else torch.stack([late(step) for step in said])
        assert arrives.equal(torch.cat((torch.full((delay, 1, 2), -1), said))[:length])


@pytest.mark.parametrize(("horizon", "cell"), [(1000, 5), (65_535, 5), (65_536, 7)])
def test_steps_above_65535_take_four_bytes(horizon, cell):
    assert cell_bytes(horizon) == cell


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 999), unit=st.sampled_from([1, 4]), **RADIO)
def test_messages_equal_plain_python_one_by_one(seed, unit, **radio):
    config, area, steps = RadioConfig(**radio), 12, 30
    world = WildfireConfig(num_uavs=UAVS, radio=config)
    sizes = torch.full((area,), 5)
    sizes[-2:] = 16
    exchange = Exchange(config, sizes, (ENVS, UAVS), unit=unit)
    known = Knowledge(envs=ENVS, uavs=UAVS, area=area, horizon=unit * 1000, fires=True)
    channel, keys = Channel(world, ENVS), counter_rng.seed_keys(seed, ENVS)
    scalars = [ScalarExchange(UAVS, sizes.tolist(), config.delay, unit) for _ in range(ENVS)]
    for step in range(1, steps):
        now = torch.full((ENVS,), step)
        cells = torch.stack([draw(97 * step + k + seed, area).argsort()[:3] for k in range(8)])
        cells, sees = cells.view(ENVS, UAVS, 3), draw(step + seed, ENVS, UAVS, 3) < 0.4
        view = View(cells + area * torch.arange(ENVS).view(-1, 1, 1), sees, sees & (cells % 2 > 0))
        known.see(view, torch.full_like(cells, unit * step))
        exchange.saw(view)
        position = draw(step // 9 + seed, ENVS, UAVS, 3).double() * 12
        near, hears = channel(position, keys, now)
        left = budget(world, near)
        sent, arrives, _ = exchange(known, hears, now, left)
        for e, scalar in enumerate(scalars):
            for uav in range(UAVS):
                seen = cells[e, uav][sees[e, uav]].tolist()
                scalar.see(uav, {cell: (unit * step, cell % 2 > 0) for cell in seen})
            limits = [None] * UAVS if left is None else left[e].tolist()
            spent, got = scalar.step(step, near[e].tolist(), hears[e].tolist(), limits)
            assert sent[e].tolist() == spent
            assert arrives[e].tolist() == got
            assert exchange.waits[e].tolist() == scalar.waits
            assert left is None or (sent <= left).all()
            assert scalar.sent == scalar.lost + scalar.arrived + len(scalar.flying)
            for uav in range(UAVS):
                looks = zip(
                    known.last_seen[e, uav].tolist(), known.seen_fire[e, uav].tolist(), strict=True
                )
                held = {c: look for c, look in enumerate(looks) if look[0] >= 0}
                assert held == scalar.known[uav]


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("method", ["maps", "positional", "consensus"])
def test_messages_and_reports_share_the_bytes_of_a_step(method, shared):
    limits = {"env.radio.bandwidth": 64, "env.radio.shared": shared, "env.radio.range": 12.0}
    env = make_env(method, num_envs=4, setup="strong", world="relay", **limits)
    sent = env.rollout(40)["next", *BYTES_SENT]
    assert (32 if method == "maps" and not shared else 0) < sent.max() <= 64
