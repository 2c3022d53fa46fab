"""Tests burn-out, knowledge, ages of sightings, the base station and failures."""

import dataclasses
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scalar_world import ScalarWorld, percentile

from emberlink.envs import WildfireConfig, WildfireEnv, keys
from emberlink.envs.config import RadioConfig, RewardConfig
from emberlink.envs.utils.errors import UserError
from emberlink.envs.world import radio
from emberlink.envs.world.coverage_map import View, with_burn_time
from emberlink.envs.world.failures import draw_failures
from emberlink.envs.world.knowledge import Knowledge
from emberlink.envs.world.measures import SightingAges, age_limits, cell_ages

ENVS = 3
COUNTS = (keys.NEW_FIRE, keys.OLD_FIRE, keys.NO_FIRE)


def action(generator: torch.Generator, uavs: int) -> torch.Tensor:
    return torch.rand(ENVS, uavs, 3, generator=generator) * 2 - 1


@settings(max_examples=25, deadline=None)
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
        hears = env._measures.hears(position.double(), now[keys.RNG_KEY], time, alive)
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
                keys.FRONT_AGE_P95: percentile(scalar.ages, 0.95),
            }
            for key, value in expected.items():
                assert now[key][e].item() == pytest.approx(value, rel=1e-6), key
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


def test_burn_out_by_hand():
    # Three cells of a row burn from steps 0, 2.5 and never, for 3 steps.
    arrival = torch.full((8, 8), math.inf)
    arrival[0, 0], arrival[1, 0] = 0.0, 2.5
    world = WildfireConfig(grid=(8, 8), num_uavs=1, horizon=7, altitude=(1.0, 1.0))
    env = WildfireEnv(1, world, with_burn_time(arrival[None], 3.0), seed=0)
    now = env.reset(position=torch.tensor([[7.0, 7.0, 1.0]]))
    burning, burnt = [now[keys.BURNING].item()], [now[keys.BURNT].item()]
    maps = [env.fire_map[0, :2, 0].tolist()]
    for _ in range(6):
        now = env.step(now.set(keys.ACTION, torch.zeros(1, 1, 3)))["next"]
        burning.append(now[keys.BURNING].item())
        burnt.append(now[keys.BURNT].item())
        maps.append(env.fire_map[0, :2, 0].tolist())
    assert burning == [1, 1, 1, 1, 1, 1, 0]  # the first until step 2, the second from 3 to 5
    assert burnt == [1, 1, 1, 2, 2, 2, 2]
    assert maps == [[2, 0], [2, 0], [2, 0], [4, 2], [4, 2], [4, 2], [4, 4]]


def test_a_cell_seen_after_it_burnt_out_does_not_count():
    arrival = torch.full((8, 8), math.inf)
    arrival[4, 4] = 0.0
    world = WildfireConfig(grid=(8, 8), num_uavs=1, horizon=9, altitude=(1.0, 1.0))
    for first_look, seen in ((3, 1), (4, 0)):  # it burns at steps 0 to 3
        env = WildfireEnv(1, world, with_burn_time(arrival[None], 4.0), seed=0)
        now = env.reset(position=torch.tensor([[4.0, 4.0 - first_look, 1.0]]))
        for _ in range(first_look):
            now = env.step(now.set(keys.ACTION, torch.tensor([[[0.0, 1.0, 0.0]]])))["next"]
        assert now[keys.POSITION][0, 0, 1] == 4
        assert now[keys.SEEN].item() == seen
        assert now[keys.OLD_FIRE].item() == 0


def test_ages_by_hand():
    step, never = torch.tensor(10), -1
    last_seen = torch.tensor([10, 7, 3, never, never])
    ignition = torch.tensor([0, 4, 5, 6, 10])
    assert cell_ages(step, last_seen, ignition).tolist() == [0, 3, 5, 4, 0]


def test_percentiles_by_hand():
    ages = SightingAges(2, 100)
    env = torch.tensor([0] * 20 + [1])
    ages.add(torch.tensor([*range(1, 21), 50]), env)
    assert ages.mean().tolist() == [10.5, 50.0]
    assert ages.percentile(0.95).tolist() == [19.0, 50.0]
    ages.start_episodes(torch.tensor([True, False]))
    assert ages.mean().tolist() == [0.0, 50.0]
    assert ages.percentile(0.95).tolist() == [0.0, 50.0]


@pytest.mark.parametrize("horizon", [1, 511, 512, 1000, 1_000_000])
def test_classes_of_ages_are_narrow_and_few(horizon):
    limits = age_limits(horizon)
    assert limits[0] == 0
    assert limits[-1] >= horizon
    assert len(limits) < 1300
    assert limits[: min(512, horizon + 1)].equal(torch.arange(min(512, horizon + 1)))
    width = limits[1:] - limits[:-1]
    assert ((width == 1) | (width <= 0.01 * limits[:-1])).all()


def looks(cells: list[list[int]], envs: int = 1) -> View:
    """Returns the view of UAVs that see the given cells of a map of 4 cells, -1 for none."""
    index = torch.tensor([cells] * envs)
    index = index.clamp(min=0) + 4 * torch.arange(envs).view(-1, 1, 1)
    in_view = torch.tensor([cells] * envs) >= 0
    return View(index, in_view, in_view)


def heard(*pairs: tuple[int, int]) -> torch.Tensor:
    """Returns links, bool [1, 3, 3]: pairs (radio, heard radio)."""
    links = torch.zeros(1, 3, 3, dtype=torch.bool)
    for pair in pairs:
        links[0][pair] = True
    return links


def test_knowledge_merges_over_groups_by_hand():
    known = Knowledge(envs=1, uavs=3, area=4, horizon=9)
    silent = heard()
    known.update(looks([[0], [1], [-1]]), torch.tensor([1]), silent)
    assert known.last_seen.tolist() == [[[1, -1, -1, -1], [-1, 1, -1, -1], [-1, -1, -1, -1]]]
    # 2 hears 1 alone; a message that is not heard back merges one map only.
    known.update(looks([[-1], [-1], [3]]), torch.tensor([2]), heard((2, 1)))
    assert known.last_seen.tolist() == [[[1, -1, -1, -1], [-1, 1, -1, -1], [-1, 1, -1, 2]]]
    # A chain passes on: 0 hears 1, 1 hears 2.
    known.update(looks([[-1], [-1], [2]]), torch.tensor([3]), heard((0, 1), (1, 2)))
    assert known.last_seen.tolist() == [[[1, 1, 3, 2], [-1, 1, 3, 2], [-1, 1, 3, 2]]]
    # In contact that lasts, new sightings arrive; older ones never replace them.
    known.update(looks([[-1], [-1], [1]]), torch.tensor([4]), heard((0, 1), (1, 2)))
    assert known.last_seen.tolist() == [[[1, 4, 3, 2], [-1, 4, 3, 2], [-1, 4, 3, 2]]]
    known.start_episodes(torch.tensor([True]))
    assert (known.last_seen == -1).all()


def test_long_episodes_use_wider_integers():
    for horizon, kind in ((32766, torch.int16), (32767, torch.int32)):
        assert Knowledge(envs=1, uavs=1, area=1, horizon=horizon).last_seen.dtype == kind


def test_failures_are_drawn_at_the_expected_rate():
    key = torch.arange(20_000)
    steps = draw_failures(key, 2.0, 6, 100)
    fails = steps <= 100
    assert fails.sum(-1).float().mean().item() == pytest.approx(2.0, abs=0.04)
    assert (steps.min(), steps.max()) == (1, 101)
    assert steps[fails].float().mean().item() == pytest.approx(50.5, abs=0.6)
    assert draw_failures(key, 0.0, 6, 100).min() == 101
    assert draw_failures(key, 6.0, 6, 100).max() <= 100


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"base": (30.0, 3.0)}, r"outside of the map, \[0, 0\] to \[29, 29\]"),
        ({"base": (-0.1, 3.0)}, "outside of the map"),
        ({"failures": 6.5}, "the team has 6 UAVs"),
    ],
)
def test_wrong_worlds_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        WildfireConfig(**settings)


def test_fires_that_burn_out_too_early_are_refused():
    times = torch.tensor([3.0, 2.0]).view(1, 2, 1, 1).expand(1, 2, 8, 8)
    world = WildfireConfig(grid=(8, 8))
    with pytest.raises(UserError, match="a cell burns out before the fire arrives"):
        WildfireEnv(1, world, times)
    with pytest.raises(UserError, match="arrival and burn-out times of shape"):
        WildfireEnv(1, world, torch.zeros(1, 3, 8, 8))


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
    assert not present & {keys.FRONT_AGE, keys.FRONT_AGE_P95, keys.BASE_SEEN, keys.BASE_AGE}
    assert env.knowledge is None
    base = dataclasses.replace(env.config, base=(0.0, 0.0))
    assert keys.BASE_SEEN in WildfireEnv(1, base, "paper", seed=0).reset().keys()  # noqa: SIM118


def test_a_uav_that_was_not_heard_of_for_150_steps_is_believed_to_have_failed():
    world = WildfireConfig(num_uavs=2, failures=1.0)
    heard = torch.tensor([[[200, 50], [51, 200]]])
    flies = radio.believed_to_fly(world, torch.tensor([200]), heard)
    assert flies.tolist() == [[[True, False], [True, True]]]
