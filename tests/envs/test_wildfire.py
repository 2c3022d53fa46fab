"""Tests the environment: single steps, resets, fires, specs. test_steps.py tests episodes."""

import dataclasses
import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import check_env_specs, step_mdp

from emberlink.envs import WildfireConfig, WildfireEnv, keys, wildfire
from emberlink.envs.fire.generator import load_scenario, make_fires
from emberlink.envs.utils.errors import UserError
from emberlink.trainers import make_env

METHODS = ("independent", "shared_memory", "positional", "consensus", "maps")
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


def test_box_observation_is_scaled():
    env = world(grid=(12, 12), observation_scale="box")
    td = start(env, [0.0, 5.5, 4])
    assert td[keys.OBSERVATION][0, 0].tolist() == [-1, 0, 1, 0, 0, 0]
    assert act(env)[keys.OBSERVATION][0, 0].tolist() == pytest.approx([-1, 0, 1, 1, 0, 1 / 20])


def test_a_cell_exactly_on_the_edge_is_in_view():
    angle = math.degrees(math.atan(0.75))
    assert 4 * math.tan(math.radians(angle)) == 3
    beyond = torch.nextafter(torch.tensor(6.0), torch.tensor(7.0)).item()
    env = world(view_angle=angle, num_uavs=2)
    start(env, [6.0, 6, 4], [beyond, 6, 4])
    assert counts(act(env)) == [(49, 0, 0), (0, 42, 0)]


def test_an_altitude_that_float32_rounds_down_is_in_the_box():
    env = world(altitude=(3.3, 4.1))
    start(env, [5.0, 5, 3.3])
    assert not act(env)[keys.HIT_BOUNDARY].any()


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


@pytest.mark.parametrize("name", ["huygens", "reaction"])
def test_fires_of_a_bank_are_drawn_each_episode(name):
    scenario = dataclasses.replace(load_scenario(name), num_train_fires=3)
    env = world(scenario, 64)
    fires = []
    for _ in range(4):
        env.reset()
        fires.append(env.arrival_time.clone())
    kinds = torch.cat(fires).flatten(1).unique(dim=0)
    assert len(kinds) == 3
    assert not torch.equal(fires[0], fires[1])


@pytest.mark.parametrize("method", METHODS)
def test_an_environment_does_not_depend_on_the_batch_size(method):
    more = {"fire": "huygens", "num_train_fires": 5, "grid": [12, 12], "num_uavs": 3, "seed": 3}
    single, five = (make_env(method, num_envs=count, **more) for count in (1, 5))
    action = torch.rand(5, 3, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1
    for _ in range(3):
        alone, among = single.reset(), five.reset()
        assert (alone == among[:1]).all()
        for _ in range(4):
            alone = single.step(alone.set(keys.ACTION, action[:1]))["next"]
            among = five.step(among.set(keys.ACTION, action))["next"]
            assert (alone == among[:1]).all()
            assert torch.equal(single.base_env.fire_map, five.base_env.fire_map[:1])


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("observation", ["vector", "window", "map"])
def test_specs_of_the_bare_environment(observation):
    env = world(num_envs=3, num_uavs=2, observation=observation)
    check_env_specs(env)
    assert not env.reset()[keys.OBSERVATION][..., 3:].any()


@pytest.mark.parametrize("method", [None, *METHODS])
def test_a_partial_reset_leaves_the_others_alone(method):
    """Compares with an environment that is not reset."""
    fire = torch.linspace(0, 20, 144).view(12, 12)
    given = {"num_envs": 3, "fire": fire, "horizon": 20, "seed": 1}
    env, twin = (make_env(method, **given) if method else world(**given) for _ in range(2))
    td, whole = env.reset(), twin.reset()
    for step in range(8):
        if step == 5:
            before = td.clone()
            td = env.reset(td.set("_reset", torch.tensor([[False], [True], [False]])))
            for key in td.keys(True, True):
                assert td[key][::2].equal(before[key][::2]), key
            assert (td[keys.POSITION][1] != before[keys.POSITION][1]).any()
        action = env.rand_action(td)[keys.ACTION]
        td, whole = (
            step_mdp(e.step(x.set(keys.ACTION, action)), keep_other=True, exclude_reward=False)
            for e, x in ((env, td), (twin, whole))
        )
    assert td[keys.STEP].tolist() == [8, 3, 8]
    for key in (keys.OBSERVATION, keys.POSITION, keys.NEW_FIRE, keys.RNG_KEY, keys.REWARD):
        assert td[key][::2].equal(whole[key][::2]), key


WORLD = {"config": WildfireConfig(grid=(12, 12), num_uavs=1)}
BAD = {
    "'papr'.*paper": {"fire": "papr"},
    "NaN": {"fire": torch.full((12, 12), math.nan), **WORLD},
    r"fire: .*\[12, 12\].*num_envs=3": {"fire": torch.zeros(2, 12, 12), "num_envs": 3, **WORLD},
    "a cell burns out before": {"fire": torch.tensor([3.0, 2]).view(1, 2, 1, 1).expand(1, 2, 9, 9)},
    "num_envs=0": {"num_envs": 0},
    "seed=-1: expected a whole number from 0": {"seed": -1},
    "device=abacus": {"device": "abacus"},
}


@pytest.mark.parametrize("message", BAD)
def test_bad_input_is_named(message):
    with pytest.raises(UserError, match=message):
        WildfireEnv(**BAD[message])


@pytest.mark.parametrize("position", [[[math.nan, 5, 2]], [[5.0, 5, 2]] * 2])
def test_start_positions_outside_the_box_are_named(position):
    with pytest.raises(UserError, match="position"):
        start(world(), *position)


def test_the_state_is_on_the_device(monkeypatch):
    """Every machine has "meta", a device without numbers, on which specs can't be made."""
    monkeypatch.setattr(wildfire, "check_device", lambda name: None)
    monkeypatch.setattr(WildfireEnv, "_make_specs", lambda env: None)
    env = WildfireEnv(2, WildfireConfig(grid=(12, 12)), EVERYWHERE, seed=0, device="meta")
    assert {buffer.device.type for buffer in env.buffers()} == {"meta"}
