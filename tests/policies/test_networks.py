"""Compares the stacked networks with one torch.nn network per UAV."""

import math

import pytest
import torch
from single_ddpg import SingleActor, SingleCritic, copy_uav

from emberlink.policies.networks.actor_critic import (
    StackedActor,
    StackedCritic,
)

UAVS, FEATURES, ACTIONS, HIDDEN = 4, 9, 3, (20, 12)
SIZES = UAVS, [(FEATURES,)], ACTIONS, HIDDEN
SINGLE = FEATURES, ACTIONS, HIDDEN


def scrambled(network):
    """Sets all parameters, the norms' included, to random values of ordinary size."""
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.uniform_(-0.7, 0.7, generator=generator)
    return network


@pytest.mark.parametrize("batch", [(), (5,), (2, 7)])
def test_stacked_actors_equal_single_networks(batch):
    stack = scrambled(StackedActor(*SIZES))
    observation = torch.randn(*batch, UAVS, FEATURES)
    actions = stack(observation)
    assert actions.shape == (*batch, UAVS, ACTIONS)
    for uav in range(UAVS):
        single = copy_uav(stack, SingleActor(*SINGLE), uav)
        expected = single(observation[..., uav, :])
        torch.testing.assert_close(actions[..., uav, :], expected, atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("batch", [(), (5,), (2, 7)])
def test_stacked_critics_equal_single_networks(batch):
    stack = scrambled(StackedCritic(*SIZES))
    observation, action = torch.randn(*batch, UAVS, FEATURES), torch.randn(*batch, UAVS, ACTIONS)
    values = stack(action, None, observation)
    assert values.shape == (*batch, UAVS, 1)
    for uav in range(UAVS):
        single = copy_uav(stack, SingleCritic(*SINGLE), uav)
        expected = single(observation[..., uav, :], action[..., uav, :])
        torch.testing.assert_close(values[..., uav, :], expected, atol=1e-5, rtol=1e-5)


def test_initial_weights_are_those_of_the_ddpg_paper():
    critic = StackedCritic(6, [(9,)], 3, (400, 300), generator=torch.Generator().manual_seed(0))
    bounds = {
        "first": 1 / math.sqrt(9),
        "second": 1 / math.sqrt(400),
        "action": 1 / math.sqrt(3),
        "value": 3e-3,
    }
    for name, bound in bounds.items():
        for values in (critic.get_submodule(name).weight, critic.get_submodule(name).bias):
            assert values.abs().max() <= bound
            assert values.abs().max() > 0.5 * bound
            assert values.mean().abs() < 0.5 * bound
    assert critic.first.weight.shape == (6, 9, 400)
    assert critic.second.weight.shape == (6, 400, 300)
    for norm in (critic.first_norm, critic.second_norm):
        assert (norm.weight == 1).all()
        assert (norm.bias == 0).all()
    actor = StackedActor(6, [(9,)], 3, (400, 300))
    assert actor.action.weight.abs().max() <= 3e-3
    assert actor.first.weight.shape[2:] == (400,)
    assert actor.second.weight.shape[1:] == (400, 300)


def test_uavs_start_from_different_weights_and_a_seed_repeats_them():
    def drawn(seed: int) -> list[torch.Tensor]:
        actor = StackedActor(*SIZES, generator=torch.Generator().manual_seed(seed))
        return [weight for name, weight in actor.named_parameters() if "norm" not in name]

    for first, same, other in zip(drawn(3), drawn(3), drawn(4), strict=True):
        assert first.equal(same)
        assert not first.equal(other)
        for uav in range(1, UAVS):
            assert not first[0].equal(first[uav])
