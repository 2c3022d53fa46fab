"""Tests the critics of DDPG and TD3 that read what the whole team observes and does."""

from typing import Any

import pytest
import torch
from test_recipes import METHODS

from emberlink.envs import keys
from emberlink.policies.networks.grouping import Grouping
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.learners.off_policy.networks import with_taken
from emberlink.trainers.learners.off_policy.samplers import TeamSampler
from emberlink.trainers.training.setup import TrainingSetup

SMALL = [
    *("setup=tuned", "env.horizon=12", "env.num_uavs=3", "num_envs=2", "episodes=4"),
    *("learner.hidden=[7,5]", "learner.batch_size=8", "learner.critic=team", "learner.gamma=0.5"),
]


def made(learner: str, *more: str, method: str = "consensus") -> TrainingSetup:
    return TrainingSetup(resolve(method, [f"learner={learner}", *SMALL, *more]))


def filled(learner: str, *more: str, method: str = "consensus") -> tuple[Any, Any]:
    """Returns a learner after some updates, and a batch."""
    setup = made(learner, *more, method=method)
    setup.dry_run(20)
    of: Any = setup.learner
    return of, with_taken(of.sample())


def test_the_features_of_a_team_begin_with_those_of_the_uav_itself():
    grouping = Grouping(3)
    x = torch.tensor([[1, 2], [3, 4], [5, 6], [10, 20], [30, 40], [50, 60]])[None]  # two teams
    assert grouping.of_team(x, 2)[0].tolist() == [
        [1, 2, 3, 4, 5, 6],
        [3, 4, 5, 6, 1, 2],
        [5, 6, 1, 2, 3, 4],
        [10, 20, 30, 40, 50, 60],
        [30, 40, 50, 60, 10, 20],
        [50, 60, 10, 20, 30, 40],
    ]
    # The channels of windows, and the features of each decision, are joined alike.
    windows = x[..., None, None].expand(-1, -1, -1, 5, 5)
    assert grouping.of_team(windows, 2)[0, 1, :, 4, 4].tolist() == [3, 4, 5, 6, 1, 2]
    decisions = torch.stack((x, -x), 2)
    assert grouping.of_team(decisions, 3, 1)[0, 4].tolist() == [
        [30, 40, 50, 60, 10, 20],
        [-30, -40, -50, -60, -10, -20],
    ]


def test_an_action_of_ones_own_replaces_the_one_that_was_taken():
    grouping = Grouping(3)
    own, taken = torch.tensor([[[1], [2], [3]]]), torch.tensor([[[10], [20], [30]]])
    assert grouping.joint(own, taken)[0].tolist() == [[1, 20, 30], [2, 30, 10], [3, 10, 20]]
    assert grouping.joint(own, taken[..., :0])[0].tolist() == [[1, 2, 3], [2, 3, 1], [3, 1, 2]]


@pytest.mark.parametrize("shared", [False, True])
def test_a_team_samples_the_same_rows(shared):
    """With a shared buffer, the UAVs exchange their places."""
    more = {"rows": 100, "seeds": (3, 4), "device": "cpu", "joint": True}
    sampler = TeamSampler(4, shared=shared, **more)
    sampler.extend(torch.arange(100))
    (rows, columns), _ = sampler.sample(range(100), 300)  # pyright: ignore[reportArgumentType]
    rows, columns = rows.unflatten(1, (2, 4)), columns.unflatten(1, (2, 4)) % 4
    assert rows.eq(rows[..., :1]).all()
    assert not rows[:, 0].equal(rows[:, 1])
    assert rows.unique().numel() > 90
    turned = (columns - torch.arange(4)) % 4
    assert turned.eq(turned[..., :1]).all()
    assert turned.unique().tolist() == ([0, 1, 2, 3] if shared else [0])


def values(learner: Any, name: str, observation, action) -> torch.Tensor:
    """Returns the values of all UAVs given the joint actions of each, [batch, uavs]."""
    with getattr(learner.loss, f"{name}_network_params").to_module(learner.loss.value_network):
        return learner.loss.value_network.module(observation, action)[..., 0]


def test_the_losses_are_those_of_maddpg():
    """An update's losses, from the actions of single UAVs."""
    learner, batch = filled("ddpg")
    agents, after = batch[keys.AGENTS], batch["next", keys.AGENTS]
    order = [[0, 1, 2], [1, 2, 0], [2, 0, 1]]
    actions = {}
    for name, observation in (("actor", agents), ("target_actor", after)):
        with getattr(learner.loss, f"{name}_network_params").to_module(learner.loss.actor_network):
            actions[name] = learner.loss.actor_network.module(observation["observation"])
    joint = {
        "taken": torch.stack([agents["action"][:, k].flatten(1) for k in order], 1),
        "next": torch.stack([actions["target_actor"][:, k].flatten(1) for k in order], 1),
    }
    joint["own"] = torch.cat((actions["actor"], joint["taken"][..., 3:]), -1)
    target = after["reward"][..., 0] + 0.5 * values(
        learner, "target_value", after["observation"], joint["next"]
    )
    error = values(learner, "value", agents["observation"], joint["taken"]) - target
    losses = learner.losses(batch)
    torch.testing.assert_close(losses["critic"], error.square().mean(0), rtol=1e-4, atol=1e-5)
    expected = -values(learner, "value", agents["observation"], joint["own"]).mean(0)
    torch.testing.assert_close(losses["actor"], expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("learner", ["ddpg", "td3"])
@pytest.mark.parametrize("memory", ["none", "gru"])
def test_a_uavs_losses_read_the_team_and_train_its_own_networks_alone(learner, memory):
    lengths = ["learner.sequence=4", "learner.burn_in=2"]
    of, batch = filled(learner, f"policy.memory={memory}", *lengths)
    changed = batch.clone()
    changed[keys.OBSERVATION][:, 2] += 10
    changed["next", *keys.OBSERVATION][:, 2] += 10
    losses, other = of.losses(batch), of.losses(changed)
    assert not losses["critic"].detach().isclose(other["critic"].detach()).any()
    assert not losses["actor"].detach().isclose(other["actor"].detach()).any()
    losses["actor"][1].backward()
    for name, gradient in of.gradients().items():
        if name.startswith("actor."):
            assert gradient[1].any(), name
            assert not gradient[[0, 2]].any(), name
    # The actors themselves read what their own UAV observes.
    network: Any = of.actor.module
    if memory == "none":
        acted = [network(x[keys.OBSERVATION]) for x in (batch, changed)]
        assert acted[0][:, :2].equal(acted[1][:, :2])


@pytest.mark.parametrize("learner", ["ddpg", "td3"])
@pytest.mark.parametrize("method", [*METHODS, "maps"])
def test_every_network_is_trained(learner, method):
    more = ["env.failures=2", "seeds=[1,2]", "policy.agent_index=true"]
    maps = ["comm.pixels=8", "policy.hold=1"]
    more += maps if method == "maps" else ["env.observation=window"]
    setup = made(learner, *more, "env.num_uavs=2", method=method)
    before = {name: value.clone() for name, value in setup.learner.weights(1).items()}
    setup.dry_run(14)
    assert not setup.guard.poll(wait=True)
    for name, value in setup.learner.weights(1).items():
        assert not value.equal(before[name]), name
