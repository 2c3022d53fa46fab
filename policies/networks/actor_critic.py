"""Actors and critics as TensorDict modules, built from an environment's specs."""

import copy
from collections.abc import Sequence
from typing import Any, TypeVar

from tensordict.nn import TensorDictModule
from torchrl.data import Composite
from torchrl.modules import ValueOperator

from emberlink.envs import keys
from emberlink.policies.networks.grouping import Grouping
from emberlink.policies.networks.layers import Generators
from emberlink.policies.networks.stacked import StackedActor, StackedCritic, StackedNetwork
from emberlink.policies.settings import PolicyConfig

Network = TypeVar("Network", bound=StackedNetwork)

STATE_ACTION_VALUE = (keys.AGENTS, "state_action_value")
"""float32 [..., uavs, 1]: the critics' output"""


def make_actor(
    observation_spec: Composite,
    action_spec: Composite,
    hidden: Sequence[int],
    *,
    share_parameters: bool = False,
    policy: PolicyConfig | None = None,
    generator: Generators = None,
) -> TensorDictModule:
    """Returns the actors of all UAVs, which map the observation to ("agents", "action").

    Args:
        observation_spec, action_spec: of the environment, batch size [num_envs].
        hidden: units of the hidden layers, 1 to 8 layers.
        share_parameters: whether all UAVs of a team use the same weights.
        policy: whether the networks also read which of the UAVs they act for; without a memory.
        generator: of the initial weights. Several generators create the same number of teams,
            which share no weights; see `Grouping`.

    Raises:
        ValueError: the number of layers or the shape of an observation is not supported.
    """
    specs = observation_spec, action_spec
    more = {"share_parameters": share_parameters, "policy": policy, "generator": generator}
    network = build(StackedActor, *specs, hidden, **more)
    in_keys: list[Any] = keys.observation_keys(observation_spec)
    return TensorDictModule(network, in_keys=in_keys, out_keys=[keys.ACTION])


def make_critic(
    observation_spec: Composite,
    action_spec: Composite,
    hidden: Sequence[int],
    *,
    share_parameters: bool = False,
    policy: PolicyConfig | None = None,
    generator: Generators = None,
) -> ValueOperator:
    """Returns the critics of all UAVs, which map observation and action to `STATE_ACTION_VALUE`.

    Arguments and errors are those of `make_actor`.
    """
    specs = observation_spec, action_spec
    more = {"share_parameters": share_parameters, "policy": policy, "generator": generator}
    network = build(StackedCritic, *specs, hidden, **more)
    in_keys: list[Any] = [*keys.observation_keys(observation_spec), keys.ACTION]
    return ValueOperator(network, in_keys=in_keys, out_keys=[STATE_ACTION_VALUE])


def build(
    network: type[Network],
    observation: Composite,
    action: Composite,
    hidden: Sequence[int],
    **more: Any,
) -> Network:
    """Returns a new network with the sizes of an environment's specs.

    Args:
        network: its type.
        observation, action: specs of the environment, batch size [num_envs].
        hidden: units of the hidden layers.
        more: other arguments of the network.
    """
    *batch, actions = action[keys.ACTION].shape
    shapes, device = keys.observation_shapes(observation), {"device": observation.device}
    return network(batch[-1], shapes, actions, hidden, **device, **more)


def team_of(network: Any, team: int, teams: int) -> Any:
    """Returns the networks of one of several teams; their weights share memory with `network`."""
    if teams == 1:
        return network
    single = copy.deepcopy(network)
    for part, stacked in zip(single.parameters(), network.parameters(), strict=True):
        part.data = stacked.data.unflatten(0, (teams, -1))[team]
    stack: Any = single.module
    stack.grouping = Grouping(stack.grouping.uavs, shared=stack.grouping.shared)
    return single
