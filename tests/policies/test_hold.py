"""Tests that actions are held, and that learners receive one transition per decision."""

from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import step_mdp

from emberlink.envs import keys
from emberlink.envs.utils.errors import UserError
from emberlink.policies.hold import HELD, Held, decisions, hold
from emberlink.policies.state import Stateful
from emberlink.trainers import make_env
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.training.setup import TrainingSetup

COUNT = (keys.AGENTS, "count")


class Counting(Stateful):
    """Writes the number of its decisions as the action."""

    uavs, carries = 2, {COUNT: 3}
    in_keys, out_keys = [keys.STEP, COUNT], [keys.ACTION, ("next", *COUNT)]

    def forward(self, tensordict):
        before = tensordict.get(COUNT, None)
        before = torch.zeros_like(tensordict.get(keys.POSITION)) if before is None else before
        tensordict.set(("next", *COUNT), before + 1)
        return tensordict.set(keys.ACTION, before + 1)


def test_holding_for_one_step_is_the_policy_itself():
    policy = Counting()
    assert hold(policy, 1, 2) is policy
    td: Any = TensorDict({}, batch_size=[2, 3])
    assert decisions(td, 1) is td


def test_an_action_is_held_and_what_is_carried_changes_at_decisions_alone():
    env = make_env("independent", num_envs=2, num_uavs=2, horizon=8, seed=1)
    policy = Held(Counting(), 3, 2)
    env.append_transform(policy.make_tensordict_primer())
    rollout = env.rollout(8, policy)
    actions = rollout[keys.ACTION][:, :, 0, 0]
    assert actions.tolist() == [[1, 1, 1, 2, 2, 2, 3, 3]] * 2
    assert rollout["next", *COUNT][:, :, 0, 0].equal(actions)


def test_environments_decide_at_their_own_steps():
    """Environment 1 begins a new episode while the action of environment 0 is held."""
    env = make_env("independent", num_envs=2, num_uavs=2, seed=1)
    policy, td = Held(Counting(), 3, 2), env.reset()
    for _ in range(2):
        td = step_mdp(env.step(policy(td)))
    td[keys.STEP] = torch.tensor([2, 0])
    acted = policy(td)
    assert acted[keys.ACTION][:, 0, 0].tolist() == [1, 2]
    assert acted["next", *HELD].equal(acted[keys.ACTION])
    assert acted["next", *COUNT][:, 0, 0].tolist() == [1, 2]


def test_a_transition_leads_from_one_decision_to_the_next():
    env = make_env("independent", num_envs=2, num_uavs=2, horizon=6, seed=1)
    policy = Held(Counting(), 3, 2)
    env.append_transform(policy.make_tensordict_primer())
    whole = env.rollout(6, policy)
    folded = decisions(whole, 3)
    assert folded.shape == (2, 2)
    assert folded[keys.STEP].tolist() == [[0, 3]] * 2
    assert folded["next", keys.STEP].tolist() == [[3, 6]] * 2
    assert folded["next", "done"][..., 0].tolist() == [[False, True]] * 2
    reward = whole["next", *keys.REWARD]
    for k in range(2):
        total = reward[:, 3 * k] + reward[:, 3 * k + 1] + reward[:, 3 * k + 2]
        torch.testing.assert_close(folded["next", *keys.REWARD][:, k], total)
    assert whole["next", *keys.REWARD].shape[1] == 6  # the rollout itself is as before


@pytest.mark.parametrize("learner", ["ddpg", "td3", "ippo"])
def test_learners_receive_decisions(learner):
    config = resolve(
        "consensus",
        [f"learner={learner}", "policy.hold=5", "env.horizon=20", "episodes=3", "num_envs=2"],
    )
    setup = TrainingSetup(config)
    received = []
    learn = setup.learner.learn
    setup.learner.learn = lambda rollout: received.append(rollout) or learn(rollout)
    setup.dry_run(40)
    assert setup.step == 40
    assert len(received) == 8
    assert all(rollout.shape == (2, 1) for rollout in received)
    assert [int(rollout[keys.STEP][0]) for rollout in received] == [0, 5, 10, 15] * 2
    actions = torch.cat([rollout[keys.ACTION] for rollout in received], 1)
    assert not actions[:, 1:].isclose(actions[:, :-1]).any()  # noise is drawn at each decision


def test_the_horizon_is_a_multiple_of_the_held_steps():
    config = resolve("independent", ["policy.hold=7", "env.horizon=20"])
    with pytest.raises(UserError, match=r"env.horizon=20: must be a multiple of 7, the steps"):
        TrainingSetup(config)


@pytest.mark.parametrize("learner", ["ddpg", "mappo", "imitation"])
def test_an_episode_has_a_decision_at_least(learner):
    config = resolve("maps", ["world=front", f"learner={learner}", "setup=tuned", "env.horizon=8"])
    with pytest.raises(UserError, match=r"env.horizon=8: must be a multiple of 10, the steps"):
        TrainingSetup(config)
