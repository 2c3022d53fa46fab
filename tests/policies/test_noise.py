"""Tests exploration: Ornstein-Uhlenbeck noise is reset per episode and repeatable."""

import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torchrl.data import Bounded, Composite, Unbounded

from emberlink.envs import keys
from emberlink.policies.exploration import NOISE, ExplorationConfig, OrnsteinUhlenbeck
from emberlink.policies.networks.actor_critic import make_actor
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.training.setup import TrainingSetup

UAVS, ENVS = 2, 4000


class Still(torch.nn.Module):
    """Always returns 0, so that the action equals the noise."""

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        return torch.zeros_like(observation[..., :3])


def explorer(*, theta: float, sigma: float, dt: float, envs: int = ENVS):
    observation = Composite({keys.OBSERVATION: Unbounded((envs, UAVS, 6))}, shape=(envs,))
    action = Composite({keys.ACTION: Bounded(-1.0, 1.0, (envs, UAVS, 3))}, shape=(envs,))
    actor = make_actor(observation, action, (8, 8))
    actor.module = Still()
    noise = OrnsteinUhlenbeck(
        ExplorationConfig(theta=theta, sigma=sigma, dt=dt), UAVS, torch.Generator().manual_seed(0)
    )
    return TensorDictSequential(actor, noise)


def play(policy, steps: int, envs: int = ENVS) -> torch.Tensor:
    """Returns the actions of the first steps of an episode, [steps, envs, uavs, 3]."""
    actions = []
    td = TensorDict({keys.OBSERVATION: torch.ones(envs, UAVS, 6)}, batch_size=[envs])
    for step in range(steps):
        td[keys.STEP] = torch.full((envs,), step)
        td = policy(td)
        actions.append(td[keys.ACTION].clone())
        td[NOISE] = td["next", *NOISE]
    return torch.stack(actions)


def test_the_noise_is_an_ornstein_uhlenbeck_process():
    theta, sigma, dt = 0.8, 0.2, 0.25
    x = play(explorer(theta=theta, sigma=sigma, dt=dt), 12)
    assert x.abs().max() < 1  # without clipping, so that the action equals the noise
    before, after = x[3:-1].flatten(), x[4:].flatten()
    slope = (before * (after - before)).mean() / before.square().mean()
    assert slope.item() == pytest.approx(-theta * dt, abs=0.01)
    rest = after - before - slope * before
    assert rest.std().item() == pytest.approx(sigma * math.sqrt(dt), rel=0.01)
    assert abs(rest.mean().item()) < 0.002
    # UAVs and components are independent.
    flat = x[-1].reshape(ENVS, -1).T
    assert (torch.corrcoef(flat) - torch.eye(UAVS * 3)).abs().max() < 0.08


def test_actions_stay_in_bounds():
    x = play(explorer(theta=0.1, sigma=5.0, dt=1.0, envs=50), 21, envs=50)
    assert x.abs().max() == 1
    assert (x.abs() == 1).float().mean() > 0.5


def test_training_resets_the_noise_each_episode(tmp_path):
    short = [
        "env.horizon=6",
        "env.num_uavs=4",
        "episodes=3",
        "num_envs=300",
        "learner.hidden=[4,4]",
    ]
    noise = [f"learner.exploration.{setting}" for setting in ("theta=0", "sigma=0.2", "dt=0.25")]
    config = resolve("independent", [*short, *noise, f"output={tmp_path}"])
    setup = TrainingSetup(config)
    with torch.no_grad():  # an actor that returns 0
        setup.learner.actor.module.action.weight.zero_()
        setup.learner.actor.module.action.bias.zero_()
    spread = [collected[keys.ACTION].std().item() for collected in setup.collector]
    expected = [0.1 * math.sqrt(step) for step in range(1, 7)] * 3
    assert spread == pytest.approx(expected, rel=0.06)
