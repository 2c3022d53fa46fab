"""Tests burn-out, knowledge, ages of sightings, the base station and failures."""

import dataclasses
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scalar_world import ScalarWorld

from emberlink.envs import WildfireConfig, WildfireEnv, keys
from emberlink.envs.config import RadioConfig, RewardConfig
from emberlink.envs.world import radio
from emberlink.envs.world.coverage_map import with_burn_time
from emberlink.envs.world.failures import draw_failures

ENVS = 3
COUNTS = (keys.NEW_FIRE, keys.OLD_FIRE, keys.NO_FIRE)


def action(generator: torch.Generator, uavs: int) -> torch.Tensor:
    return torch.rand(ENVS, uavs, 3, generator=generator) * 2 - 1


@settings(max_examples=12, deadline=None)
@given(
    seed=st.integers(0, 2**20),
    uavs=st.integers(1, 4),
    limit=st.sampled_from([0.0, 3.0, 6.0, math.inf]),
    loss=st.sampled_from([0.0, 0.5]),
    failures=st.sampled_from([0.0, 0.7]),
    burn_time=st.sampled_from([1.0, 4.5, math.inf]),
    unseen=st.sampled_from([0.0, -0.1]),
)
def test_every_step_equals_plain_python(seed, uavs, limit, loss, failures, burn_time, unseen):
    world = WildfireConfig(
        grid=(9, 8),
        num_uavs=uavs,
        horizon=16,
        altitude=(0.5, 3.0),
        radio=RadioConfig(range=limit, loss=loss),
        base=(0.0, 4.0),
        failures=failures,
        measures="all",
        reward=RewardConfig(base=0.5, unseen=unseen),
    )
    generator = torch.Generator().manual_seed(seed)
    arrival = torch.rand(ENVS, 9, 8, generator=generator) * 24 - 2
    arrival[arrival > 18] = math.inf
    fire = with_burn_time(arrival, burn_time)
    env = WildfireEnv(ENVS, world, fire, seed=seed)
    burn_out = (arrival + burn_time).tolist()
    scalars = [
        ScalarWorld(arrival[e].tolist(), burn_out[e], world.view_angle, uavs) for e in range(ENVS)
    ]
    now = env.reset()
    base = torch.tensor([[0.0, 4.0, 0.0]]).expand(ENVS, 1, 3)
    for step in range(1, world.horizon + 1):
        before = now[keys.POSITION]
        now = env.step(now.set(keys.ACTION, action(generator, uavs)))["next"]
        alive, position = now[keys.ALIVE], now[keys.POSITION]
        assert position[~alive].equal(before[~alive])
        assert not now[keys.REWARD][~alive].any()
        assert not (now[keys.NEW_FIRE] + now[keys.OLD_FIRE] + now[keys.NO_FIRE])[~alive].any()
        time = now[keys.STEP]
        _, hears = env._measures.channel(position.double(), now[keys.RNG_KEY], time, alive)
        near = radio.neighbours(torch.cat((position, base), 1), limit)
        lives = torch.nn.functional.pad(alive, (0, 1), value=True)
        assert not (hears & ~(near & lives.unsqueeze(-1) & lives.unsqueeze(-2))).any()
        for e, scalar in enumerate(scalars):
            scalar.step(step, position[e].tolist(), alive[e].tolist(), hears[e].tolist())
            expected = {
                keys.SEEN: scalar.seen_fire(),
                keys.BURNING: scalar.burning(step),
                keys.BURNT: scalar.burnt(step),
                keys.BASE_SEEN: scalar.base_seen(),
                keys.FRONT_AGE: sum(scalar.ages) / max(1, len(scalar.ages)),
                keys.BASE_AGE: sum(scalar.base_ages) / max(1, len(scalar.base_ages)),
            }
            for key, value in expected.items():
                assert now[key][e] == torch.tensor(value), key
            for uav, told in enumerate(scalar.told):
                new, old, none = (now[key][e, uav].item() for key in COUNTS)
                inside = new - 4 * old - 10 * none + 0.5 * told
                left = now[keys.HIT_BOUNDARY][e, uav].any()
                late = unseen * math.log(1 + scalar.unseen(step)) * alive[e, uav].item()
                expected = late + (-100 if left else inside)
                if late:  # float32
                    expected = pytest.approx(expected, rel=1e-6, abs=1e-6)
                assert now[keys.REWARD][e, uav].item() == expected
    maps = env._map._sensor.crop(env.knowledge.last_seen)
    for e, scalar in enumerate(scalars):
        for node in range(uavs + 1):
            for i, j in scalar.cells:
                assert maps[e, node, i, j] == scalar.last_seen(node, (i, j))


def test_failures_are_drawn_at_the_expected_rate():
    key = torch.arange(20_000)
    steps = draw_failures(key, 2.0, 6, 100)
    fails = steps <= 100
    assert fails.sum(-1).float().mean().item() == pytest.approx(2.0, abs=0.04)
    assert (steps.min(), steps.max()) == (1, 101)
    assert steps[fails].float().mean().item() == pytest.approx(50.5, abs=0.6)
    assert draw_failures(key, 0.0, 6, 100).min() == 101
    assert draw_failures(key, 6.0, 6, 100).max() <= 100


def test_partial_resets_start_all_records_anew():
    world = WildfireConfig(
        grid=(8, 8), num_uavs=2, horizon=20, measures="all", base=(0.0, 0.0), failures=1.0
    )
    fire = with_burn_time(torch.rand(1, 8, 8) * 10, 5.0)
    env = WildfireEnv(ENVS, world, fire, seed=1)
    now = env.reset()
    generator = torch.Generator().manual_seed(0)
    for _ in range(6):
        now = env.step(now.set(keys.ACTION, action(generator, 2)))["next"]
    kept = {name: value.clone() for name, value in env.state_dict().items()}
    now["_reset"] = torch.tensor([[False], [True], [False]])
    env.reset(now)
    fresh = WildfireEnv(ENVS, world, fire, seed=1)
    fresh.reset()
    fresh.reset()  # the second episode of environment 1
    for name, value in env.state_dict().items():
        assert value[[0, 2]].equal(kept[name][[0, 2]]) or "arrival" in name or "burn_out" in name
        if "arrival" not in name and "burn_out" not in name:
            assert value[1].equal(fresh.state_dict()[name][1]), name


def test_measures_that_are_not_asked_for_are_not_made():
    env = WildfireEnv(1, WildfireConfig(grid=(8, 8)), "paper", seed=0)
    present = set(env.reset().keys(True))
    assert not present & {keys.FRONT_AGE, keys.BASE_SEEN, keys.BASE_AGE}
    assert env.knowledge is None
    base = dataclasses.replace(env.config, base=(0.0, 0.0))
    assert keys.BASE_SEEN in WildfireEnv(1, base, "paper", seed=0).reset().keys()  # noqa: SIM118


def test_a_uav_that_was_not_heard_of_for_150_steps_is_believed_to_have_failed():
    world = WildfireConfig(num_uavs=2, failures=1.0)
    heard = torch.tensor([[[200, 50], [51, 200]]])
    flies = radio.believed_to_fly(world, torch.tensor([200]), heard)
    assert flies.tolist() == [[[True, False], [True, True]]]
