"""Tests which cells UAVs recognise (`env.sensor`), and which fire is new (`env.knowledge`)."""

import itertools
import math

import pytest
import torch

from emberlink.envs import keys
from emberlink.envs.config import WildfireConfig
from emberlink.envs.utils import counter_rng
from emberlink.envs.utils.counter_rng import Use
from emberlink.envs.wildfire import WildfireEnv
from emberlink.envs.world.sensor import search_altitude
from emberlink.policies.scripted.map_greedy import MapGreedy
from emberlink.trainers import make_env
from emberlink.trainers.replay.recording import Recorder

ENVS, UAVS, STEPS, SIDE, WINDOW = 2, 3, 40, 12, 5
NEAR, FAR = 0.9, 0.2
COUNTS = (keys.NEW_FIRE, keys.OLD_FIRE, keys.NO_FIRE)


def flown(hold: int = 1, burn_time: float = 15, **more):
    generator = torch.Generator().manual_seed(4)
    arrival = 50 * torch.rand(ENVS, SIDE, SIDE, generator=generator)
    fires = torch.stack((arrival, arrival + burn_time), 1)
    world = WildfireConfig(grid=(SIDE, SIDE), num_uavs=UAVS, horizon=STEPS, **more)
    env = WildfireEnv(ENVS, world, fires, seed=7, hold=hold)
    actions = 2 * torch.rand(STEPS // 2, ENVS, UAVS, 3, generator=generator) - 1
    td, steps = env.reset(), []
    for action in actions.repeat_interleave(2 // hold, 0):
        td = env.step(td.set(keys.ACTION, action))["next"]
        steps.append(td.exclude(keys.ACTION))
    return steps, fires


@pytest.mark.parametrize(
    ("knowledge", "chances", "burn_time", "failures"),
    [
        ("team", (NEAR, FAR), 15, 1),
        ("own", (NEAR, FAR), 15, 1),
        ("own", (1, 1), 1e9, 0),
        ("own", (1, 1), 12, 3),
    ],
)
def test_what_a_uav_recognises_is_that_of_a_scalar_twin(knowledge, chances, burn_time, failures):
    world = {"knowledge": knowledge, "observation": "window", "failures": failures}
    steps, fires = flown(burn_time=burn_time, sensor=chances, **world)
    (near, far), slope, missed, new_to_one = chances, math.tan(math.radians(30)), 0, 0
    for env in range(ENVS):
        team, own = set(), [set() for _ in range(UAVS)]
        arrival, end = fires[env].tolist()
        for now in (step[env] for step in steps):
            k = now[keys.STEP].item()
            key = counter_rng.step_key(now[keys.RNG_KEY], now[keys.STEP], Use.RECOGNITION)
            unit = counter_rng.uniform(key, UAVS * WINDOW**2).tolist()
            for uav in range(UAVS):
                x, y, z = (float(c) for c in now[keys.POSITION][uav])
                chance = near + (far - near) * (z - 1) / 3
                new, old, none = [], [], []
                for a, b in itertools.product(range(WINDOW), range(WINDOW)):
                    i, j = round(x) + a - 2, round(y) + b - 2
                    if not (now[keys.ALIVE][uav] and 0 <= i < SIDE and 0 <= j < SIDE):
                        continue
                    if abs(i - x) > z * slope or abs(j - y) > z * slope:
                        continue
                    if unit[(uav * WINDOW + a) * WINDOW + b] >= chance:
                        missed += 1
                    elif not arrival[i][j] <= k < end[i][j]:
                        none.append((i, j))
                    else:
                        known = own[uav] if knowledge == "own" else team
                        (old if (i, j) in known else new).append((i, j))
                new_to_one += sum(cell in team for cell in new)
                team.update(new)
                own[uav].update(new)
                found = [now[key][uav].item() for key in COUNTS]
                assert found == [len(new), len(old), len(none)]
                for key, cells in ((keys.NEW_CENTRE, new), (keys.OLD_CENTRE, old)):
                    mean = [sum(c) / len(cells) for c in zip(*cells, strict=True)] or [0, 0]
                    assert now[key][uav].tolist() == pytest.approx(mean, abs=1e-5)
                assert now[keys.OBSERVATION][uav, 3:5].tolist() == [bool(new), bool(old)]
                assert now[keys.WINDOW][uav].sum().item() == len(new) + len(old) + len(none)
            assert now[keys.SEEN].item() == len(team)
    assert missed > 500 or chances == (1, 1)
    assert (new_to_one > 0) == (knowledge == "own")


def test_rewards_and_measures_are_those_of_the_team():
    for own, team in zip(
        *(flown(failures=2, knowledge=k)[0] for k in ("own", "team")), strict=True
    ):
        for key in (keys.REWARD, keys.SEEN, keys.BURNING, keys.POSITION, keys.NO_FIRE):
            assert own[key].equal(team[key]), key


def test_a_perfect_sensor_is_no_sensor():
    for one, two in zip(flown()[0], flown(sensor=(1, 1))[0], strict=True):
        assert (one == two).all()


def test_held_actions_equal_single_steps():
    single, held = flown(sensor=(NEAR, FAR))[0], flown(2, sensor=(NEAR, FAR))[0]
    for one, two in zip(single[1::2], held, strict=True):
        assert one[keys.NEW_FIRE].equal(two[keys.NEW_FIRE])
        assert one[keys.SEEN].equal(two[keys.SEEN])


def test_scripted_maps_hold_what_was_recognised_alone():
    env = make_env("independent", "tuned", world="relay", num_envs=2, seed=1, num_train_fires=2,
                   horizon=40, sensor=[0.9, 0.1])  # fmt: skip
    policy, td = MapGreedy(env.base_env), env.reset()
    policy.maps.update(td)
    for _ in range(30):
        td = env.step(policy(td))["next"]
        policy.maps.update(td)
        uavs = env.base_env.knowledge.last_seen
        assert policy.maps.known.last_seen[..., :-6].equal(uavs)


def test_the_best_altitude_is_found_by_hand():
    assert search_altitude(WildfireConfig(altitude=(1.0, 3.3))) == torch.tensor(3.3).item()
    world = WildfireConfig(sensor=(1.0, 0.0), displacement=0.2)

    def recognised(z: float) -> float:
        width = 2 * z * math.tan(math.radians(30))
        return width * (1 - (1 - (4 - z) / 3) ** (width / 0.2))

    best = search_altitude(world)
    assert 3.4 < best < 3.9
    assert all(recognised(best) >= recognised(best + by) for by in (-0.06, 0.06))


def test_a_recording_knows_what_was_recognised():
    env = make_env("independent", "tuned", world="front", seed=1, num_train_fires=2, horizon=60,
                   sensor=[0.3, 0.05], num_uavs=3)  # fmt: skip
    recorder, td, policy = Recorder(), env.reset(), MapGreedy(env.base_env)
    recorder.add(env, td)
    for _ in range(60):
        td = env.step(policy.fly(td, torch.full((1, 3, 3), 30.0)))["next"]
        recorder.add(env, td)
    recorded = recorder.recording()
    assert (recorded.first_seen <= 60).sum() == td[keys.SEEN].item() > 0
    assert recorded.steps["missed"][1:].any((1, 2, 3)).all()
