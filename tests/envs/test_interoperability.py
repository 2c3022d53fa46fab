"""Tests the environment with other programs: seeds, ends, TorchRL's wrapper, Gymnasium."""

import copy
import pickle

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from tensordict import TensorDict
from torchrl.envs import SerialEnv
from torchrl.envs.libs.pettingzoo import PettingZooWrapper

from emberlink.envs import WildfireConfig, WildfireEnv, keys, parallel_env
from emberlink.envs.utils.errors import UserError
from emberlink.trainers import make_env

CONFIG = WildfireConfig(grid=(12, 10), num_uavs=3, horizon=10)
FIRE = torch.linspace(0, 20, 120).view(12, 10)


def make(num_envs=2, **options) -> WildfireEnv:
    return WildfireEnv(num_envs, options.pop("config", CONFIG), FIRE, **options)


def starts(env) -> torch.Tensor:
    return env.reset()[keys.POSITION]


def test_unseeded_environments_differ():
    assert not starts(make()).equal(starts(make()))
    assert not starts(make_env("consensus")).equal(starts(make_env("consensus")))
    unused = make()
    first, second = copy.deepcopy(unused), pickle.loads(pickle.dumps(unused))
    assert not starts(first).equal(starts(second))
    workers = starts(SerialEnv(2, make))
    assert not workers[0].equal(workers[1])


def test_both_ways_of_seeding_are_equivalent():
    made, set_later = make(seed=4), make()
    set_later.set_seed(4)
    assert starts(made).equal(starts(set_later))
    assert starts(made).equal(starts(set_later)), "the next episode too"
    set_later.set_seed(None)
    assert not starts(make(seed=4)).equal(starts(set_later))


def test_an_episode_with_a_base_and_spells_of_losses_repeats():
    chosen = {"world": "relay", "env.radio.loss": 0.5, "env.radio.burst": 200.0}
    env, told = make_env("independent", num_envs=8, fire=torch.zeros(60, 60), **chosen), []
    for _ in range(2):
        env.set_seed(0)
        torch.manual_seed(0)  # of the actions
        told.append(env.rollout(30)["next", keys.BASE_SEEN])
    assert told[0].any()
    assert told[0].equal(told[1])


@pytest.mark.filterwarnings("error")
def test_the_team_as_one_agent_of_gymnasium():
    name = "emberlink.envs.gymnasium:emberlink/WildfireTeam-v0"
    env = gymnasium.make(name, config=CONFIG, fire=FIRE)
    assert env.observation_space.shape == (18,)
    assert env.action_space.shape == (9,)
    check_env(env.unwrapped, skip_render_check=True)
    first, info = env.reset(seed=3, options={"position": np.full((3, 3), 2.0)})
    assert first.reshape(3, 6)[:, :3].tolist() == [[2, 2, 2]] * 3
    assert set(info) == {"seen", "burning", "burnt"}
    core = make(1, seed=3)
    core.reset(position=torch.full((3, 3), 2.0))
    for step in range(1, 11):
        action = env.action_space.sample()
        observation, reward, terminated, truncated, info = env.step(action)
        acts = TensorDict({keys.ACTION: torch.from_numpy(action).view(1, 3, 3)}, [1])
        after = core.step(acts)["next"]
        assert np.array_equal(observation, after[keys.OBSERVATION].flatten().numpy())
        assert reward == pytest.approx(after[keys.REWARD].mean().item())
        assert (terminated, truncated) == (False, step == 10)
        assert info["seen"] == after[keys.SEEN].item()
    env.reset()
    for wrong in (np.zeros(10, np.float32), np.zeros((3, 3), np.float32)):
        with pytest.raises(UserError, match=r"shape \(9,\), got"):
            env.unwrapped.step(wrong)
    with pytest.raises(UserError, match="holds NaN"):
        env.unwrapped.step(np.full(9, np.nan, np.float32))


@pytest.mark.parametrize("method", ["consensus", "maps"])
def test_a_policy_flies_the_team_of_gymnasium(method):
    name = "emberlink.envs.gymnasium:emberlink/WildfireTeam-v0"
    given = {"fire": FIRE, "num_uavs": 3, "horizon": 10, "seed": 1}
    env = gymnasium.make(name, env=make_env(method, **given), render_mode="rgb_array")
    core = make_env(method, **given)

    def policy(td):
        return td.set(keys.ACTION, (td[keys.POSITION] / 20 - 0.3).clamp(-1, 1))

    steps = core.rollout(10, policy)["next"]
    env.reset()
    for t in range(10):
        observation, reward, _, truncated, _ = env.step(env.unwrapped.act(policy))
        assert env.observation_space.contains(observation)
        assert reward == pytest.approx(steps[keys.REWARD][0, t].mean().item())
    if method == "maps":
        assert np.array_equal(observation["crops"], steps[keys.CROPS][0, -1].numpy())
    assert truncated
    assert env.render().ndim == 3


@pytest.mark.parametrize("seed", [5, 6])
def test_torchrls_wrapper_plays_the_first_episodes_of_its_seed(seed):
    """It resets when it is made and before the first step, and sends actions of failed UAVs."""
    config = WildfireConfig(grid=(12, 10), num_uavs=3, horizon=8, failures=3.0)
    core = WildfireEnv(1, config, FIRE, seed=seed)
    made = {"use_mask": True, "done_on_any": False, "seed": seed}
    env = PettingZooWrapper(parallel_env(config=config, fire=FIRE), **made)
    for _ in range(2):
        core.reset()
        last = core.fail_step.max().clamp(max=8).item()
        steps = env.rollout(20)["next"]
        assert len(steps) == last
        fell = [flags.nonzero()[0].item() + 1 for flags in steps["uav", "terminated"][..., 0].T]
        assert fell == core.fail_step[0].tolist()
