"""Tests the networks' initial weights; test_ddpg.py compares them with plain torch modules."""

import math

import torch

from emberlink.policies.networks.actor_critic import StackedActor, StackedCritic

UAVS, FEATURES, ACTIONS, HIDDEN = 4, 9, 3, (20, 12)
SIZES = UAVS, [(FEATURES,)], ACTIONS, HIDDEN


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
