"""Tests the PettingZoo environment with PettingZoo's tests and against the TorchRL environment."""

import copy

import numpy as np
import pytest
import torch
from pettingzoo import ParallelEnv
from pettingzoo.test import (
    api_test,
    max_cycles_test,
    parallel_api_test,
    parallel_seed_test,
    render_test,
)
from pettingzoo.test.state_test import state_test
from pettingzoo.utils.conversions import parallel_to_aec
from tensordict import TensorDict
from torchrl.envs import EnvBase, SerialEnv, step_mdp

from emberlink.envs import WildfireConfig, WildfireEnv, keys, parallel_env, pettingzoo
from emberlink.envs.utils.errors import UserError
from emberlink.trainers import make_env

pytestmark = pytest.mark.filterwarnings("error")
METHODS = ("independent", "shared_memory", "positional", "consensus", "maps")
FIRE = torch.linspace(0, 60, 12 * 10).view(12, 10)


def small(**options):
    config = WildfireConfig(grid=(12, 10), num_uavs=3, horizon=30)
    return parallel_env(config=config, fire=FIRE, **options)


def recipe(method: str, setup: str = "paper") -> EnvBase:
    return make_env(method, setup, fire=FIRE, num_uavs=3, horizon=30)


def test_pettingzoo_parallel_api():
    env = small()
    assert isinstance(env, ParallelEnv)
    parallel_api_test(env, num_cycles=100)
    api_test(parallel_to_aec(small()), num_cycles=100)


def test_pettingzoo_seeds():
    parallel_seed_test(small, num_cycles=100)


def test_pettingzoo_max_cycles_and_state():
    max_cycles_test(pettingzoo)
    state_test(parallel_to_aec(small()), small(), num_cycles=20)


def test_pettingzoo_rendering(monkeypatch):
    monkeypatch.setenv("MPLBACKEND", "agg")
    render_test(lambda **options: parallel_to_aec(small(**options)))


@pytest.mark.parametrize("method", METHODS)
def test_recipes_pass_the_api_test(method):
    parallel_api_test(parallel_env(recipe(method)), num_cycles=35)
    parallel_seed_test(lambda: parallel_env(recipe(method)), num_cycles=20)


def compare(td: TensorDict, observations, infos, agents) -> None:
    for i, agent in enumerate(agents):
        given = observations[agent]
        if isinstance(given, dict):
            assert np.array_equal(given["crops"], td[keys.CROPS][0, i].numpy())
            given = given["observation"]
        assert given.dtype == np.float32
        assert np.array_equal(given, td[keys.OBSERVATION][0, i].numpy())
        for key in ("position", "new_fire", "old_fire", "no_fire", "hit_boundary"):
            assert np.array_equal(infos[agent][key], td[keys.AGENTS, key][0, i].numpy())
        assert infos[agent]["seen"] == td[keys.SEEN].item()


@pytest.mark.parametrize("setup", ["paper", "released", "tuned"])
@pytest.mark.parametrize("method", [None, *METHODS])
def test_same_transitions_as_torchrl(method, setup):
    if method is None:
        config = WildfireConfig(grid=(12, 10), num_uavs=3, horizon=30)
        torch_env, env = WildfireEnv(1, config, FIRE), parallel_env(config=config, fire=FIRE)
    else:
        torch_env, env = recipe(method, setup), parallel_env(recipe(method, setup))
    generator = np.random.default_rng(0)
    torch_env.set_seed(11)
    for episode in range(2):
        td = torch_env.reset()
        observations, infos = env.reset(seed=None if episode else 11)
        compare(td, observations, infos, env.possible_agents)
        for step in range(1, 31):
            action = generator.uniform(-1.2, 1.2, (3, 3)).astype(np.float32)
            td.set(keys.ACTION, torch.from_numpy(action)[None])
            following = torch_env.step(td)
            td = step_mdp(following, keep_other=True)
            after = following["next"]
            result = env.step(dict(zip(env.agents, action, strict=True)))
            observations, rewards, terminated, truncated, infos = result
            compare(after, observations, infos, env.possible_agents)
            assert list(rewards.values()) == after[keys.REWARD][0, :, 0].tolist()
            assert set(terminated.values()) == {after["terminated"].item()} == {False}
            assert set(truncated.values()) == {after["truncated"].item()} == {step == 30}
            assert env.agents == ([] if step == 30 else env.possible_agents)


def test_seeds():
    env, other = small(seed=5), small()
    here, _ = env.reset()
    there, _ = other.reset(seed=5)
    assert all(np.array_equal(here[agent], there[agent]) for agent in here)
    following, _ = env.reset()
    assert not np.array_equal(following["uav_0"], here["uav_0"])
    again, _ = env.reset(seed=5)
    assert np.array_equal(again["uav_0"], here["uav_0"])


def test_spaces():
    env = small()
    assert env.possible_agents == ["uav_0", "uav_1", "uav_2"]
    space, action = env.observation_space("uav_0"), env.action_space("uav_0")
    assert space.low.tolist() == [0, 0, 1, 0, 0, 0]
    assert space.high.tolist() == [11, 9, 4, 1, 1, 30]
    assert (action.low.tolist(), action.high.tolist()) == ([-1] * 3, [1] * 3)
    assert len({id(env.action_space(agent)) for agent in env.possible_agents}) == 3
    assert parallel_env(recipe("positional")).observation_space("uav_0").shape == (18,)
    wide = parallel_env(recipe("consensus")).observation_space("uav_0")
    assert wide.shape == (9,)
    assert np.isinf(wide.high).all()


@pytest.mark.parametrize("observation", ["raw", "box"])
@pytest.mark.parametrize("altitude", [(1.0, 4.0), (3.3, 4.1), (255.3, 255.9), (2.0, 2.0)])
def test_every_observation_is_in_its_space(observation, altitude):
    config = WildfireConfig(
        num_uavs=4, horizon=25, observation_scale=observation, altitude=altitude
    )
    env = parallel_env(config=config)
    observations, _ = env.reset()
    while True:
        for agent, seen in observations.items():
            assert env.observation_space(agent).contains(seen), seen
        if not env.agents:
            break
        push = {agent: 3 * env.action_space(agent).sample() for agent in env.agents}
        observations, *_ = env.step(push)


def test_rendering(monkeypatch):
    monkeypatch.setenv("MPLBACKEND", "agg")
    env = small(render_mode="rgb_array")
    env.reset()
    assert env.render().shape == (300, 360, 3)
    window = small(render_mode="human")
    window.reset()
    window.step({agent: np.zeros(3, np.float32) for agent in window.agents})
    assert window._window is not None
    assert window.render() is None
    window.close()
    window.close()


def test_a_copy_with_an_open_window_is_independent(monkeypatch):
    monkeypatch.setenv("MPLBACKEND", "agg")
    env = small(render_mode="human", seed=2)
    env.reset()
    other = copy.deepcopy(env)
    assert other._window is None
    actions = {agent: np.ones(3, np.float32) for agent in env.agents}
    (here, *_), (there, *_) = env.step(actions), other.step(actions)
    assert np.array_equal(here["uav_1"], there["uav_1"])
    env.close()
    other.close()


def test_start_positions_are_an_option():
    env = small()
    position = np.array([[0.0, 9, 1], [11, 0, 4], [5, 5, 2]], np.float32)
    observations, _ = env.reset(seed=1, options={"position": position})
    assert np.array_equal(np.stack(list(observations.values()))[:, :3], position)
    assert np.array_equal(env.state(), np.concatenate(list(observations.values())))
    for options, message in (
        ({"positions": position}, "positions not known; known: position"),
        ({"position": position + 9}, "inside the box"),
    ):
        with pytest.raises(ValueError, match=message):
            env.reset(options=options)
    with pytest.raises(ValueError, match=r"state\(\)"):
        small().state()


def test_spaces_are_listed():
    env = small()
    assert list(env.observation_spaces) == list(env.action_spaces) == env.possible_agents
    assert env.observation_spaces["uav_1"] is env.observation_space("uav_1")
    assert env.action_spaces["uav_1"] is env.action_space("uav_1")


def test_max_cycles_is_the_horizon():
    env = parallel_env(fire=FIRE, max_cycles=3)
    assert env.unwrapped._core.config.horizon == 3
    assert env.unwrapped._core.config.grid == (12, 10)
    with pytest.raises(ValueError, match="max_cycles"):
        parallel_env(recipe("independent"), max_cycles=3)


def test_windows_are_a_dictionary():
    config = WildfireConfig(grid=(12, 10), num_uavs=3, horizon=30, observation="window")
    env = parallel_env(config=config, fire=FIRE, seed=4)
    core = WildfireEnv(1, config, FIRE, seed=4)
    parallel_api_test(parallel_env(config=config, fire=FIRE), num_cycles=40)
    parallel_seed_test(lambda: parallel_env(config=config, fire=FIRE), num_cycles=20)
    env.reset()
    core.reset()
    for _ in range(10):
        push = {agent: env.action_space(agent).sample() for agent in env.agents}
        observations, *_ = env.step(push)
        action = torch.from_numpy(np.stack(list(push.values())))[None]
        after = core.step(TensorDict({keys.ACTION: action}, [1]))["next"]
        for i, agent in enumerate(env.agents):
            assert env.observation_space(agent).contains(observations[agent])
            assert np.array_equal(observations[agent]["window"], after[keys.WINDOW][0, i].numpy())
            vector = after[keys.OBSERVATION][0, i].numpy()
            assert np.array_equal(observations[agent]["observation"], vector)


def test_returned_arrays_do_not_change_later():
    env = small()
    observations, infos = env.reset()
    kept = [observations["uav_0"].copy(), infos["uav_0"]["position"].copy()]
    env.step({agent: np.ones(3, np.float32) for agent in env.agents})
    assert np.array_equal(observations["uav_0"], kept[0])
    assert np.array_equal(infos["uav_0"]["position"], kept[1])


def test_bad_input_is_named():
    with pytest.raises(ValueError, match=r"'ascii'.*rgb_array"):
        small(render_mode="ascii")
    with pytest.raises(ValueError, match=r"\[1\].*\[2\]"):
        parallel_env(num_envs=2)
    with pytest.raises(ValueError, match=r"\[1\].*\[2\]"):
        parallel_env(make_env("independent", num_envs=2))
    with pytest.raises(ValueError, match="seed"):
        parallel_env(recipe("independent"), seed=3)
    with pytest.raises(UserError, match="'num_env' is not known; did you mean num_envs"):
        parallel_env(num_env=1)
    with pytest.raises(UserError, match=r"^max_cycles: horizon=0: [^\n]*$"):
        parallel_env(max_cycles=0)
    with pytest.raises(ValueError, match="SerialEnv"):
        parallel_env(SerialEnv(1, WildfireEnv))
    env = small()
    null = np.zeros(3, np.float32)
    with pytest.raises(ValueError, match=r"reset\(\)"):
        env.step(dict.fromkeys(env.possible_agents, null))
    with pytest.raises(ValueError, match="render_mode"):
        env.render()
    env.reset()
    with pytest.raises(ValueError, match="uav_2"):
        env.step({"uav_0": null, "uav_1": null})
    with pytest.raises(ValueError, match=r"\(3,\)"):
        env.step(dict.fromkeys(env.agents, np.zeros(2, np.float32)))
    with pytest.raises(UserError, match="action of uav_0: up is no array"):
        env.step(dict.fromkeys(env.agents, "up"))
    with pytest.raises(UserError, match=r"action of uav_1: .* holds NaN"):
        env.step({**dict.fromkeys(env.agents, null), "uav_1": null * np.nan})
    with pytest.raises(ValueError, match="uav_9"):
        env.step({**dict.fromkeys(env.agents, null), "uav_9": null})


def test_actions_of_agents_that_have_left_are_ignored():
    config = WildfireConfig(grid=(12, 10), num_uavs=3, horizon=30, failures=3.0)
    env, other = (parallel_env(config=config, fire=FIRE, seed=2) for _ in range(2))
    env.reset()
    other.reset()
    push = np.full(3, 0.5, np.float32)
    left = dict.fromkeys(env.possible_agents, push * np.nan)
    while env.agents:
        live = dict.fromkeys(env.agents, push)
        for here, there in zip(env.step({**left, **live}), other.step(live), strict=True):
            assert here.keys() == there.keys()
    assert env.step(left) == env.step({}) == ({}, {}, {}, {}, {})
