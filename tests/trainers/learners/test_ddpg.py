"""Tests that UAVs of the stacked learner are independent and equal to plain DDPG."""

import copy

import pytest
import torch
from single_ddpg import SingleActor, SingleCritic, SingleDDPG, copy_uav, matched
from tensordict import TensorDict
from torchrl.data import Bounded, Composite, Unbounded

from emberlink.envs import keys
from emberlink.policies.exploration import ExplorationConfig
from emberlink.policies.settings import PolicyConfig
from emberlink.trainers.learners.base import LearnerContext
from emberlink.trainers.learners.ddpg import DDPG, DDPGConfig
from emberlink.trainers.learners.replay import DONE, TERMINATED, to_rows

UAVS, FEATURES, ACTIONS, HIDDEN, BATCH = 3, 9, 3, (16, 12), 24
RATES = {
    "gamma": 0.95,
    "tau": 0.05,
    "actor_lr": 1e-3,
    "critic_lr": 1e-2,
    "critic_weight_decay": 0.01,
}


def make_learner(*, index=False, shared_replay=False, **more) -> DDPG:
    observation = Composite({keys.OBSERVATION: Unbounded((1, UAVS, FEATURES))}, shape=(1,))
    action = Composite({keys.ACTION: Bounded(-1, 1, (1, UAVS, ACTIONS))}, shape=(1,))
    config = DDPGConfig(
        name="ddpg",
        hidden=HIDDEN,
        updates_per_step=1,
        batch_size=BATCH,
        buffer_size=100,
        exploration=ExplorationConfig(theta=0.2, sigma=0.15, dt=0.01),
        **{**RATES, **more},
    )
    context = LearnerContext(
        observation_spec=observation,
        action_spec=action,
        num_uavs=UAVS,
        num_envs=1,
        seed=5,
        shared_replay=shared_replay,
        policy=PolicyConfig(agent_index=index),
        total_steps=100,
        device="cpu",
    )
    return DDPG(config, context)


def make_batch(seed: int) -> TensorDict:
    """Returns random transitions; some end an episode, by its terminal state or the horizon."""
    generator = torch.Generator().manual_seed(seed)

    def draw(width: int) -> torch.Tensor:
        return torch.randn(BATCH, UAVS, width, generator=generator)

    ends = draw(1)
    flags = {DONE: ends < 0, TERMINATED: ends < -0.5}
    following = {keys.OBSERVATION: draw(FEATURES), keys.REWARD: 5 * draw(1), **flags}
    return TensorDict(
        {
            keys.OBSERVATION: draw(FEATURES),
            keys.ACTION: draw(ACTIONS).tanh(),
            "next": TensorDict(following, batch_size=[BATCH]),
        },
        batch_size=[BATCH],
    )


def of_uav(batch: TensorDict, uav: int) -> tuple[torch.Tensor, ...]:
    following = batch["next"]
    tensors = (
        batch[keys.OBSERVATION],
        batch[keys.ACTION],
        following[keys.REWARD],
        following[keys.OBSERVATION],
        following[TERMINATED],
    )
    return tuple(t[:, uav] for t in tensors)


def networks(learner: DDPG) -> dict[str, torch.nn.Module]:
    """Returns copies of the actors, the critics and their targets with their current weights."""
    copies = {}
    for name in ("actor", "value"):
        module = getattr(learner.loss, f"{name}_network")
        for kind in ("", "target_"):
            with getattr(learner.loss, f"{kind}{name}_network_params").data.to_module(module):
                copies[kind + name] = copy.deepcopy(module.module)
    return copies


def single(learner: DDPG, uav: int) -> SingleDDPG:
    stacks = networks(learner)
    actor = copy_uav(stacks["actor"], SingleActor(FEATURES, ACTIONS, HIDDEN), uav)
    critic = copy_uav(stacks["value"], SingleCritic(FEATURES, ACTIONS, HIDDEN), uav)
    return SingleDDPG(actor, critic, **RATES)


@pytest.mark.parametrize("which", ["actor", "critic"])
@pytest.mark.parametrize("uav", range(UAVS))
def test_gradients_of_uavs_are_independent(which, uav):
    learner = make_learner(critic="team")
    learner.losses(make_batch(0))[which][uav].backward()
    trained = {"actor": "actor_network_params", "critic": "value_network_params"}
    for place, network in trained.items():
        for name, weight in getattr(learner.loss, network).items(True, True):
            gradient = weight.grad
            if place != which:
                assert gradient is None or not gradient.any(), (network, name)
                continue
            others = [k for k in range(UAVS) if k != uav]
            assert gradient[uav].any(), (network, name)
            assert not gradient[others].any(), (network, name)


def test_each_uav_of_the_stack_equals_a_single_ddpg():
    learner = make_learner()
    singles = [single(learner, uav) for uav in range(UAVS)]
    for step in range(10):
        batch = make_batch(step)
        losses = learner.update(batch)
        for uav, ddpg in enumerate(singles):
            expected = ddpg.update(*of_uav(batch, uav))
            computed = losses["actor"][uav].item(), losses["critic"][uav].item()
            assert computed == pytest.approx(expected, rel=1e-4, abs=1e-5)
    hand = {
        "actor": "actor",
        "value": "critic",
        "target_actor": "target_actor",
        "target_value": "target_critic",
    }
    for kind, stack in networks(learner).items():
        for uav, ddpg in enumerate(singles):
            for name, ours, theirs in matched(stack, getattr(ddpg, hand[kind]), uav):
                torch.testing.assert_close(ours, theirs, atol=2e-6, rtol=0, msg=f"{kind} {name}")


def test_the_losses_of_team_critics_are_those_of_maddpg():
    """A UAV's critic reads the team's observations and actions, its own first."""
    learner = make_learner(critic="team")
    for seed in range(3):
        learner.update(make_batch(seed))
    batch, stacks, orders = make_batch(9), networks(learner), [[0, 1, 2], [1, 2, 0], [2, 0, 1]]
    following, taken = batch["next"], batch[keys.ACTION]
    own = stacks["actor"](batch[keys.OBSERVATION])
    after = stacks["target_actor"](following[keys.OBSERVATION])
    losses = learner.losses(batch)
    for uav, order in enumerate(orders):
        wide = SingleCritic(UAVS * FEATURES, UAVS * ACTIONS, HIDDEN)
        critic = copy_uav(stacks["value"], wide, uav)
        seen = batch[keys.OBSERVATION][:, order].flatten(1)
        acted = torch.cat((own[:, uav], taken[:, order[1:]].flatten(1)), -1)
        value = critic(seen, taken[:, order].flatten(1))
        expected = -critic(seen, acted).mean()
        torch.testing.assert_close(losses["actor"][uav], expected, rtol=1e-4, atol=1e-5)
        critic = copy_uav(stacks["target_value"], wide, uav)
        beyond = critic(
            following[keys.OBSERVATION][:, order].flatten(1), after[:, order].flatten(1)
        )
        beyond = beyond.where(~following[TERMINATED][:, uav], 0.0)
        target = following[keys.REWARD][:, uav] + RATES["gamma"] * beyond
        expected = (value - target).square().mean()
        torch.testing.assert_close(losses["critic"][uav], expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("own", [True, False])
def test_which_uavs_transitions_a_shared_network_learns_from(own):
    """A network that reads the index of a UAV learns from the column of that UAV."""
    learner = make_learner(share_parameters=True, index=own, shared_replay=True)
    rows = torch.arange(float(UAVS)).view(1, 1, UAVS, 1)
    flags = torch.zeros(1, 30, 1, dtype=torch.bool)
    agents = TensorDict({"observation": rows.expand(1, 30, UAVS, FEATURES)}, [1, 30, UAVS])
    after = agents.copy().set("reward", rows.expand(1, 30, UAVS, 1))
    following = {keys.AGENTS: after, "done": flags, "terminated": flags.clone()}
    agents.set("action", rows.expand(1, 30, UAVS, ACTIONS))
    learner.replay.extend(
        to_rows(TensorDict({keys.AGENTS: agents, "next": following}, [1, 30]), learner.context)
    )
    drawn = learner.replay.sample()["action"][..., 0]
    share = (drawn == torch.arange(float(UAVS))).float().mean()
    assert share == 1 if own else 0.1 < share < 0.7


def test_a_warm_start_moves_the_actors_and_their_targets():
    learner, other = make_learner(), make_learner(share_parameters=False)
    other.update(make_batch(0))
    learner.start_from(other.weights())
    stacks, theirs = networks(learner), networks(other)
    for name in ("actor", "target_actor"):
        for mine, of_other in zip(
            stacks[name].parameters(), theirs["actor"].parameters(), strict=True
        ):
            assert mine.equal(of_other)
