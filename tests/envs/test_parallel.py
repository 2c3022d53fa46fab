"""Tests the PettingZoo environment with PettingZoo's tests and against the TorchRL environment."""

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
from torchrl.envs import EnvBase, step_mdp

from emberlink.envs import WildfireConfig, WildfireEnv, keys, parallel_env, pettingzoo
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
    config = WildfireConfig(grid=(12, 10), num_uavs=3, horizon=30, failures=3.0)
    parallel_api_test(parallel_env(config=config, fire=FIRE), num_cycles=100)


def test_pettingzoo_seeds_cycles_and_state():
    parallel_seed_test(small, num_cycles=100)
    max_cycles_test(pettingzoo)
    state_test(parallel_to_aec(small()), small(), num_cycles=20)


def test_pettingzoo_rendering(monkeypatch):
    monkeypatch.setenv("MPLBACKEND", "agg")
    render_test(lambda **options: parallel_to_aec(small(**options)))


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


@pytest.mark.parametrize("method", [None, *METHODS])
def test_same_transitions_as_torchrl(method):
    if method is None:
        config = WildfireConfig(grid=(12, 10), num_uavs=3, horizon=30)
        torch_env, env = WildfireEnv(1, config, FIRE), parallel_env(config=config, fire=FIRE)
    else:
        torch_env, env = recipe(method, "tuned"), parallel_env(recipe(method, "tuned"))
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


@pytest.mark.parametrize(
    ("observation", "altitude"), [("raw", (3.3, 4.1)), ("box", (255.3, 255.9)), ("box", (2.0, 2.0))]
)
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


def test_start_positions_are_an_option():
    env = small()
    position = np.array([[0.0, 9, 1], [11, 0, 4], [5, 5, 2]], np.float32)
    observations, _ = env.reset(seed=1, options={"position": position})
    assert np.array_equal(np.stack(list(observations.values()))[:, :3], position)
    assert np.array_equal(env.state(), np.concatenate(list(observations.values())))
    with pytest.raises(ValueError, match="inside the box"):
        env.reset(options={"position": position + 9})
    with pytest.raises(TypeError, match="positions"):
        env.reset(options={"positions": position})
    with pytest.raises(ValueError, match=r"reset\(\)"):
        small().state()


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
