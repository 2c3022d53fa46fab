"""Tests the environment: single steps, resets, fires, seeds. test_steps.py tests episodes."""

import dataclasses
import math
from itertools import product

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import check_env_specs, step_mdp

from emberlink.envs import WildfireConfig, WildfireEnv, keys
from emberlink.envs.fire.generator import load_scenario, make_fires
from emberlink.envs.utils.errors import UserError
from emberlink.trainers import make_env

METHODS = ("independent", "shared_memory", "positional", "consensus", "maps")
SETUPS = ("paper", "released", "tuned")
EVERYWHERE = torch.zeros(12, 12)
NOWHERE = torch.full((12, 12), math.inf)


def world(fire=EVERYWHERE, num_envs=1, seed=0, **changes) -> WildfireEnv:
    grid = tuple(fire.shape[-2:]) if isinstance(fire, torch.Tensor) else (12, 12)
    config = WildfireConfig(**{"grid": grid, "num_uavs": 1, "horizon": 20, **changes})
    return WildfireEnv(num_envs, config, fire, seed)


def act(env: WildfireEnv, *actions) -> TensorDict:
    """Runs a step of a single environment with an action per UAV, zeros if none is given."""
    uavs = env.config.num_uavs
    action = torch.tensor([actions]) if actions else torch.zeros(1, uavs, 3)
    return env.step(TensorDict({keys.ACTION: action}, [1]))["next"]


def start(env: WildfireEnv, *positions) -> TensorDict:
    return env.reset(position=torch.tensor(positions))


def counts(td: TensorDict) -> list[tuple[int, int, int]]:
    """Returns the counts of new, old and no fire in view of each UAV."""
    columns = (td[key][0].tolist() for key in (keys.NEW_FIRE, keys.OLD_FIRE, keys.NO_FIRE))
    return list(zip(*columns, strict=True))


def rewards(td: TensorDict) -> list[float]:
    return td[keys.REWARD][0, :, 0].tolist()


def test_the_first_of_two_uavs_over_the_same_cells_discovers():
    env = world(num_uavs=2)
    start(env, [3.0, 3, 2], [3, 3, 2])
    td = act(env)  # 2 tan 30 = 1.15: cells 2, 3 and 4 along x and y
    assert counts(td) == [(9, 0, 0), (0, 9, 0)]
    assert rewards(td) == [9, -36]
    assert counts(act(env)) == [(0, 9, 0), (0, 9, 0)]
    assert env.fire_map[0, 2:5, 2:5].eq(1).all()
    assert env.fire_map.eq(1).sum() == 9
    assert env.fire_map.eq(2).sum() == 144 - 9


def test_each_cell_goes_to_the_uav_of_lowest_index():
    env = world(num_uavs=3)
    start(env, [4.0, 3, 2], [3, 3, 2], [5, 4, 2])
    td = act(env)
    # UAV 1 adds column 2; UAV 2 sees columns 4 to 6, rows 3 to 5; UAV 0 saw 2 x 2 of them.
    assert counts(td) == [(9, 0, 0), (3, 6, 0), (5, 4, 0)]
    assert rewards(td) == [9, 3 - 24, 5 - 16]
    assert td[keys.SEEN].item() == 17
    assert td[keys.BURNING].item() == 144


def test_fire_spreads_before_uavs_look():
    fire = NOWHERE.clone()
    fire[3, 3], fire[3, 4] = 2, 2.5
    env = world(fire)
    start(env, [3.0, 3, 2])
    seen = [counts(act(env))[0] for _ in range(4)]
    assert seen == [(0, 0, 9), (1, 0, 8), (1, 1, 7), (0, 2, 7)]


def test_flags_are_per_step_and_time_counts():
    fire = NOWHERE.clone()
    fire[3, 3] = 2
    env = world(fire)
    first = start(env, [3.0, 3, 2])
    tds = [first, *(act(env) for _ in range(3))]
    flags = [td[keys.OBSERVATION][0, 0].tolist() for td in tds]
    assert flags == [[3, 3, 2, 0, 0, 0], [3, 3, 2, 0, 0, 1], [3, 3, 2, 1, 0, 2], [3, 3, 2, 0, 1, 3]]


def test_box_observation_is_scaled():
    env = world(grid=(12, 12), observation_scale="box")
    td = start(env, [0.0, 5.5, 4])
    assert td[keys.OBSERVATION][0, 0].tolist() == [-1, 0, 1, 0, 0, 0]
    assert act(env)[keys.OBSERVATION][0, 0].tolist() == pytest.approx([-1, 0, 1, 1, 0, 1 / 20])


def test_views_are_cut_by_the_grid():
    env = world(NOWHERE[:, :9], num_uavs=4)  # 4 tan 30 = 2.3: up to two cells each way
    start(env, [0.0, 0, 4], [11, 8, 4], [0, 4, 4], [5, 8, 4])
    assert counts(act(env)) == [(0, 0, 9), (0, 0, 9), (0, 0, 15), (0, 0, 15)]


def test_a_cell_exactly_on_the_edge_is_in_view():
    angle = math.degrees(math.atan(0.75))
    assert 4 * math.tan(math.radians(angle)) == 3
    beyond = torch.nextafter(torch.tensor(6.0), torch.tensor(7.0)).item()
    env = world(view_angle=angle, num_uavs=2)
    start(env, [6.0, 6, 4], [beyond, 6, 4])
    assert counts(act(env)) == [(49, 0, 0), (0, 42, 0)]


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("direction", [-1.0, 1.0])
@pytest.mark.parametrize("exit_axes", ["xyz", "xy"])
def test_leaving_the_box_costs_on_the_tested_axes(axis, direction, exit_axes):
    reward = dataclasses.replace(WildfireConfig().reward, exit_axes=exit_axes)
    env = world(NOWHERE, reward=reward)
    edge = [[0.0, 0, 1], [11.0, 11, 4]][direction > 0][axis]
    position = [[5.0, 5, 2]]
    position[0][axis] = edge
    start(env, *position)
    push = [0.0, 0, 0]
    push[axis] = direction
    td = act(env, push)
    assert td[keys.POSITION][0].tolist() == position
    assert td[keys.HIT_BOUNDARY][0, 0].tolist() == [a == axis for a in range(3)]
    tested = "xyz"[axis] in exit_axes
    assert (rewards(td)[0] == -100) == tested
    # A UAV exactly at the edge has not left the box.
    position[0][axis] -= direction
    start(env, *position)
    assert not act(env, push)[keys.HIT_BOUNDARY].any()


def test_an_edge_that_float32_rounds_is_inside():
    env = world(altitude=(3.3, 4.1))
    for z, push in ((3.5, -1.0), (4.0, 1.0)):
        start(env, [5.0, 5, z])
        assert act(env, [0, 0, push])[keys.HIT_BOUNDARY].any()
        assert not act(env)[keys.HIT_BOUNDARY].any()


def test_actions_are_clipped():
    env = world()
    start(env, [5.0, 5, 2])
    assert act(env, [3.0, -7.0, 1.5])[keys.POSITION][0, 0].tolist() == [6, 4, 3]


def test_reset_starts_in_the_box_without_seen_cells():
    env = world(num_envs=200, num_uavs=3, altitude=(2.0, 3.0))
    env.rollout(5)
    td = env.reset()
    position = td[keys.POSITION]
    low, high = torch.tensor(env.config.low), torch.tensor(env.config.high)
    assert ((position >= low) & (position <= high)).all()
    near = 0.02 * (high - low)  # 600 uniform points are this near to each side
    assert (position.flatten(0, 1).amin(0) < low + near).all()
    assert (position.flatten(0, 1).amax(0) > high - near).all()
    for key in (
        keys.NEW_FIRE,
        keys.OLD_FIRE,
        keys.NO_FIRE,
        keys.SEEN,
        keys.STEP,
        keys.HIT_BOUNDARY,
    ):
        assert not td[key].any(), key
    assert not td[keys.OBSERVATION][..., 3:].any()
    assert env.fire_map.eq(2).all()


@pytest.mark.parametrize("method", [None, "consensus"])
def test_partial_reset_leaves_the_others_alone(method):
    fire = torch.linspace(0, 20, 144).view(12, 12)
    env = make_env(method, num_envs=3, fire=fire, horizon=20) if method else world(fire, 3)
    core = env.base_env if method else env
    td = env.reset()
    for _ in range(5):
        td = step_mdp(env.step(env.rand_action(td)), keep_other=True)
    before, burning = td.clone(), core.fire_map
    mask = torch.tensor([[False], [True], [False]])
    after = env.reset(td.set("_reset", mask))
    for key in before.keys(True, True):
        if key in after.keys(True, True):
            assert (after[key][0::2] == before[key][0::2]).all(), key
    assert (core.fire_map[0::2] == burning[0::2]).all()
    assert after[keys.STEP].tolist() == [5, 0, 5]
    assert core.fire_map[1].eq(2).sum() == fire.le(0).sum()
    assert (after[keys.POSITION][1] != before[keys.POSITION][1]).any()
    following = env.step(env.rand_action(after))["next"]
    assert following[keys.STEP].tolist() == [6, 1, 6]
    same_stream = following[keys.RNG_KEY] == before[keys.RNG_KEY]
    assert same_stream.tolist() == [True, False, True]


def test_an_episode_is_truncated_at_the_horizon_and_never_terminated():
    steps = world(num_envs=2).rollout(50)["next"]
    assert steps.batch_size == (2, 20)
    expected = [False] * 19 + [True]
    for env in range(2):
        assert steps["truncated"][env, :, 0].tolist() == expected
        assert steps["done"][env, :, 0].tolist() == expected
    assert not steps["terminated"].any()


def test_fire_by_name_by_config_and_by_arrival_times():
    scenario = load_scenario("paper")
    arrival = make_fires(scenario, torch.tensor([0]), (12, 12), 20)
    arrivals = torch.stack([NOWHERE, EVERYWHERE, arrival[0]])
    for fire in ("paper", scenario, arrival[0], arrival.expand(3, -1, -1)):
        env = world(fire, 3)
        assert torch.equal(env.arrival_time, arrival.expand(3, -1, -1))
    env = world(arrivals, 3)
    for _ in range(2):
        env.reset()
        assert torch.equal(env.arrival_time, arrivals)
    assert WildfireEnv(1, None, torch.zeros(9, 17)).config.grid == (9, 17)


@pytest.mark.parametrize("layout", ["turned", "expanded", "sliced"])
def test_arrival_times_may_be_strided_and_are_copied(layout):
    plain = torch.rand(3, 9, 12)
    fire = {
        "turned": plain.mT.contiguous().mT,
        "expanded": plain[:1].expand(3, 9, 12),
        "sliced": torch.cat((plain, plain), -1)[..., :12],
    }[layout]
    env = world(fire, 3)
    expected = fire.clone()
    env.rollout(2)
    fire.add_(1) if layout != "expanded" else plain.add_(1)
    assert torch.equal(env.arrival_time, expected)


def test_fires_of_a_bank_are_drawn_each_episode():
    scenario = dataclasses.replace(load_scenario("huygens"), num_train_fires=3)
    env = world(scenario, 64)
    fires = []
    for _ in range(4):
        env.reset()
        fires.append(env.arrival_time.clone())
    kinds = torch.cat(fires).flatten(1).unique(dim=0)
    assert len(kinds) == 3
    assert not torch.equal(fires[0], fires[1])


@pytest.mark.parametrize("shape", [(12,), (12, 11), (11, 12), (2, 12, 12), (1, 3, 12, 12)])
def test_arrival_times_of_a_wrong_shape_are_named(shape):
    with pytest.raises(ValueError, match=r"fire: .*\[12, 12\].*num_envs=3"):
        WildfireEnv(3, WildfireConfig(grid=(12, 12)), torch.zeros(shape))


def test_other_bad_input_is_named():
    with pytest.raises(ValueError, match="NaN"):
        world(torch.full((12, 12), math.nan))
    with pytest.raises(ValueError, match=r"'papr'.*paper"):
        world("papr")
    for nothing in (None, b"fire"):
        with pytest.raises(ValueError, match=f"not {type(nothing).__name__}"):
            WildfireEnv(fire=nothing)
    for number in (2.5, "x", True, torch.tensor(2.5)):
        with pytest.raises(UserError, match=r"num_envs=.*expected a whole number"):
            WildfireEnv(number)
        with pytest.raises(UserError, match=r"seed=.*expected a whole number"):
            WildfireEnv(2, seed=number)
    with pytest.raises(ValueError, match="num_envs=0"):
        WildfireEnv(0)
    for position in ([[5.0, 5, 9]], [[math.nan, 5, 2]], [[5.0, 5, 2], [5, 5, 2]]):
        with pytest.raises(UserError, match="position"):
            start(world(), *position)
    point = torch.tensor([5.0, 5, 2])
    team = point.expand(1, 3)
    for position in (team.expand(2, 1, 3), team[:, :2], team[None, None], point, "centre", [[]]):
        with pytest.raises(UserError, match=r"position: .*; expected \[1, 3\] or \["):
            world(num_envs=3).reset(position=position)
    assert world(num_envs=3).reset(position=team.tolist()).shape == (3,)
    for seed in (-1, 2**63):
        with pytest.raises(UserError, match=f"seed={seed}: expected a whole number from 0"):
            WildfireEnv(seed=seed)
        with pytest.raises(UserError, match=f"seed={seed}: expected a whole number from 0"):
            world().set_seed(seed)
    for bad in ({"grid": (7, 30)}, {"num_uavs": 65}, {"altitude": (4.0, 1.0)}, {"horizon": 0}):
        with pytest.raises(ValueError, match=next(iter(bad))):
            WildfireConfig(**bad)


@pytest.mark.parametrize("shape", [(20, 24), (3, 20, 24), (1, 2, 20, 24)])
@pytest.mark.parametrize("kind", [np.asarray, torch.as_tensor])
def test_the_default_grid_is_that_of_given_times(shape, kind):
    assert WildfireEnv(3, fire=kind(np.full(shape, 9.0, np.float32))).config.grid == (20, 24)
    with pytest.raises(UserError, match=r"fire: .*grid"):
        WildfireEnv(fire=kind(np.zeros((3, 20, 7), np.float32)))


def test_an_environment_does_not_depend_on_the_batch_size():
    scenario = dataclasses.replace(load_scenario("huygens"), num_train_fires=5)
    single, five = world(scenario, 1, seed=3), world(scenario, 5, seed=3)
    action = torch.rand(5, 1, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1
    for _ in range(3):
        alone, among = single.reset(), five.reset()
        assert (alone == among[:1]).all()
        assert torch.equal(single.arrival_time, five.arrival_time[:1])
        for _ in range(4):
            alone = single.step(TensorDict({keys.ACTION: action[:1]}, [1]))["next"]
            among = five.step(TensorDict({keys.ACTION: action}, [5]))["next"]
            assert (alone == among[:1]).all()
            assert torch.equal(single.fire_map, five.fire_map[:1])


def test_seeds_reproduce_and_differ():
    first, same, other = (world(num_envs=2, seed=seed) for seed in (1, 1, 2))
    starts = [env.reset()[keys.POSITION] for env in (first, same, other)]
    assert torch.equal(starts[0], starts[1])
    assert (starts[0] != starts[2]).all()
    assert (starts[0][0] != starts[0][1]).all()
    assert (first.reset()[keys.POSITION] != starts[0]).all()
    first.set_seed(1)
    assert torch.equal(first.reset()[keys.POSITION], starts[0])


@pytest.mark.filterwarnings("error")
def test_specs_of_the_bare_environment():
    check_env_specs(world(num_envs=3, num_uavs=2))


@pytest.mark.parametrize(("method", "setup"), list(product(METHODS, SETUPS)))
def test_specs_of_every_recipe(method, setup):
    check_env_specs(make_env(method, setup, num_envs=2, fire=EVERYWHERE, horizon=10))
