"""The networks as TensorDict modules, built from an environment's specs."""

import copy
from typing import Any

import torch
from tensordict.nn import TensorDictModule
from torchrl.data import Composite
from torchrl.modules import ValueOperator

from emberlink.envs import keys

from .stacked import Generators, StackedActor, StackedCritic, of_teams

STATE_ACTION_VALUE = (keys.AGENTS, "state_action_value")


def make_actor(
    observation: Composite,
    action: Composite,
    hidden: tuple[int, int],
    *,
    generator: Generators = None,
) -> TensorDictModule:
    """The UAVs' actors: ("agents", "observation") -> ("agents", "action").

    Args:
        observation, action: specs of the environment, batch size [num_envs].
        hidden: sizes of the two hidden layers.
        generator: of the initial weights; several make as many teams, see `networks`.
    """
    network = _stacked(StackedActor, observation, action, hidden, generator)
    return TensorDictModule(network, in_keys=[keys.OBSERVATION], out_keys=[keys.ACTION])


def make_critic(
    observation: Composite,
    action: Composite,
    hidden: tuple[int, int],
    *,
    generator: Generators = None,
) -> ValueOperator:
    """The UAVs' critics; arguments as `make_actor`."""
    network = _stacked(StackedCritic, observation, action, hidden, generator)
    return ValueOperator(
        network, in_keys=[keys.OBSERVATION, keys.ACTION], out_keys=[STATE_ACTION_VALUE]
    )


def _stacked(
    kind: type[StackedActor] | type[StackedCritic],
    observation: Composite,
    action: Composite,
    hidden: tuple[int, int],
    generator: Generators,
) -> StackedActor | StackedCritic:
    uavs, features = observation[keys.OBSERVATION].shape[-2:]
    device = torch.device(observation.device or "cpu")
    actions = action[keys.ACTION].shape[-1]
    uavs *= len(of_teams(generator))
    return kind(uavs, features, actions, hidden, device=device, generator=generator)


def team_of(network: TensorDictModule, team: int, teams: int) -> TensorDictModule:
    """One team's networks out of a stack; they share its memory, so that they learn with it."""
    if teams == 1:
        return network
    single = copy.deepcopy(network)
    for own, stacked in zip(single.parameters(), network.parameters(), strict=True):
        own.data = stacked.data.unflatten(0, (teams, -1))[team]
    stack: Any = single.module
    stack.uavs //= teams
    return single
