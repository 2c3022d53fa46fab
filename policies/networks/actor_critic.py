"""Actors and critics as TensorDict modules, built from an environment's specs."""

import copy
from collections.abc import Sequence
from typing import Any

import torch
from tensordict.nn import TensorDictModule
from torchrl.data import Composite
from torchrl.modules import ValueOperator

from emberlink.envs import keys
from emberlink.policies.networks.grouping import Grouping
from emberlink.policies.networks.layers import Generators
from emberlink.policies.networks.stacked import StackedActor, StackedCritic

STATE_ACTION_VALUE = (keys.AGENTS, "state_action_value")
"""float32 [..., uavs, 1]: the critics' output"""


def make_actor(
    observation_spec: Composite,
    action_spec: Composite,
    hidden: Sequence[int],
    *,
    share_parameters: bool = False,
    generator: Generators = None,
) -> TensorDictModule:
    """Returns the UAVs' actors: the tensors of the observation -> ("agents", "action").

    Args:
        observation_spec, action_spec: of the environment, batch size [num_envs].
        hidden: units of the hidden layers.
        share_parameters: whether all UAVs of a team use the same weights.
        generator: of the initial weights. Several generators make as many teams, which share no
            weights; see `Grouping`.
    """
    observations: list[Any] = keys.observation_keys(observation_spec)
    sizes = _sizes(observation_spec, action_spec)
    network = StackedActor(
        *sizes,
        hidden,
        share_parameters=share_parameters,
        device=observation_spec.device,
        generator=generator,
    )
    return TensorDictModule(network, in_keys=observations, out_keys=[keys.ACTION])


def make_critic(
    observation_spec: Composite,
    action_spec: Composite,
    hidden: Sequence[int],
    *,
    share_parameters: bool = False,
    generator: Generators = None,
) -> ValueOperator:
    """Returns the UAVs' critics: observation and action -> `STATE_ACTION_VALUE`.

    Arguments as `make_actor`.
    """
    observations: list[Any] = keys.observation_keys(observation_spec)
    sizes = _sizes(observation_spec, action_spec)
    network = StackedCritic(
        *sizes,
        hidden,
        share_parameters=share_parameters,
        device=observation_spec.device,
        generator=generator,
    )
    in_keys = [*observations, keys.ACTION]
    return ValueOperator(network, in_keys=in_keys, out_keys=[STATE_ACTION_VALUE])


def _sizes(observation: Composite, action: Composite) -> tuple[int, list[torch.Size], int]:
    """Returns the UAVs, the shapes of their observation's tensors, and the size of an action."""
    *batch, actions = action[keys.ACTION].shape
    shapes = [observation[key].shape[len(batch) :] for key in keys.observation_keys(observation)]
    return batch[-1], shapes, actions


def team_of(network: TensorDictModule, team: int, teams: int) -> TensorDictModule:
    """Returns one team's networks out of several; they share memory, so that they learn with it."""
    if teams == 1:
        return network
    single = copy.deepcopy(network)
    for part, stacked in zip(single.parameters(), network.parameters(), strict=True):
        part.data = stacked.data.unflatten(0, (teams, -1))[team]
    stack: Any = single.module
    stack.grouping = Grouping(stack.grouping.uavs, shared=stack.grouping.shared)
    return single
