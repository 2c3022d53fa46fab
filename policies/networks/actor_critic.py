"""The actor and critic of the paper (section III.C), with weights per UAV or shared."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import Composite

from emberlink.envs import keys
from emberlink.policies.networks.encoders import ObservationEncoder
from emberlink.policies.networks.grouping import Grouping
from emberlink.policies.networks.layers import Layer, StackedLayerNorm, StackedLinear

STATE_ACTION_VALUE = (keys.AGENTS, "state_action_value")
"""float32 [..., uavs, 1]: the critics' output"""
TAKEN = (keys.AGENTS, "taken")
"""float32 [..., uavs, 3]: actions of the replay buffer, for critics of the team; missing where all
UAVs take the actions of their (target) actors"""
LAYER_NAMES = ("first", "second", "third", "fourth", "fifth", "sixth", "seventh", "eighth")
"""names of the hidden layers"""
MAX_BATCHED = 2**17
"""activations of a group's widest layer below which a CPU computes all groups in one product; more
(over 0.5 MB) would not stay in its cache from one layer to the next"""
FINAL_BOUND = 3e-3
"""bound of the initial weights of the last layer (Lillicrap et al. 2016, section 7)"""


class _Stacked(nn.Module):
    """The common part of actors and critics: an encoder and hidden layers with a LayerNorm each.

    Args:
        uavs: number of UAVs in a team.
        observations: shape of each tensor of an observation, per UAV: [features], [channels, W, W]
            or [pictures, channels, S, S].
        actions: number of components of an action.
        hidden: units of the hidden layers, 1 to 8 layers.
        share_parameters: whether the UAVs share their weights.
        agent_index: whether the index of the UAV is an input.
        team: whether the inputs of a UAV are the observations and actions of its whole team.
        start: see `layers.Start`.
    """

    def __init__(
        self,
        uavs: int,
        observations: Sequence[Sequence[int]],
        actions: int,
        hidden: Sequence[int],
        *,
        share_parameters: bool = False,
        agent_index: bool = False,
        team: bool = False,
        **start: Any,
    ):
        super().__init__()
        self.grouping = Grouping(uavs, shared=share_parameters)
        self.names, self.widest = LAYER_NAMES[: len(hidden)], max(hidden)
        self._dims, self._indexed, self._team = len(observations[0]), agent_index, team
        if team:
            observations = [(n * uavs, *sides) for n, *sides in observations]
            actions *= uavs
        if agent_index:
            observations = [(observations[0][0] + uavs,), *observations[1:]]
        groups = self.grouping.groups
        self.encoder = ObservationEncoder(groups, observations, **start)
        inputs = self.encoder.features
        for name, units in zip(self.names, hidden, strict=True):
            self.add_module(name, StackedLinear(groups, inputs, units, **start))
            norm = StackedLayerNorm(groups, units, device=start.get("device"))
            self.add_module(f"{name}_norm", norm)
            inputs = units
        self._add_output(groups, actions, inputs, **start)

    def _add_output(self, groups: int, actions: int, inputs: int, **start: Any) -> None:
        raise NotImplementedError

    def _encode(self, observations: Sequence[Tensor], batch: torch.Size) -> Tensor:
        """Returns the input of the hidden layers, [groups, rows, features]."""
        if self._team:
            observations = [self.grouping.of_team(x, len(batch)) for x in observations]
        if self._indexed:
            observations = [self.grouping.with_index(observations[0]), *observations[1:]]
        return self.encoder([self.grouping.split(x, batch) for x in observations])

    def _hidden_layers(self) -> list[Any]:
        return [getattr(self, name + kind) for name in self.names for kind in ("", "_norm")]

    def _map(self, function: Callable[..., Tensor], layers: list[Any], *inputs: Tensor) -> Tensor:
        """Applies a function of layers and inputs to all groups at once, or to one after another.

        Args:
            function: maps layers and inputs to an output.
            layers: the stacked layers.
            inputs: [groups, rows, features] each.

        Returns:
            [groups, rows, features].
        """
        x = inputs[0]
        if x.is_cuda or x.shape[1] * self.widest < MAX_BATCHED:
            return function(layers, *inputs)
        by_group = zip(*(layer.per_group() for layer in layers), strict=True)
        return torch.stack([function(*group) for group in zip(by_group, *inputs, strict=True)])


# ReLU and tanh are computed in place: no gradient needs the output of the layer before.


def _to_features(layers: Sequence[Layer], x: Tensor) -> Tensor:
    """Returns the last hidden layer before its ReLU, given a linear map and a norm per layer."""
    *before, last, last_norm = layers
    for linear, norm in zip(before[::2], before[1::2], strict=True):
        x = norm(linear(x)).relu_()
    return last_norm(last(x))


def _to_action(layers: Sequence[Layer], x: Tensor) -> Tensor:
    *hidden, last = layers
    return last(_to_features(hidden, x).relu_()).tanh_()


def _to_value(layers: Sequence[Layer], x: Tensor, action: Tensor) -> Tensor:
    *hidden, from_action, last = layers
    return last((_to_features(hidden, x) + from_action(action)).relu_())


class StackedActor(_Stacked):
    """Maps observations to actions in [-1, 1], with a tanh behind the last layer."""

    def _add_output(self, groups: int, actions: int, inputs: int, **start: Any) -> None:
        self.action = StackedLinear(groups, inputs, actions, bound=FINAL_BOUND, **start)

    def forward(self, *observations: Tensor) -> Tensor:
        """Maps the tensors of an observation, [*batch, uavs, ...], to [*batch, uavs, actions]."""
        batch = observations[0].shape[: -self._dims]
        layers = [*self._hidden_layers(), self.action]
        x = self._map(_to_action, layers, self._encode(observations, batch))
        return self.grouping.join(x, batch)


class StackedCritic(_Stacked):
    """Maps observations and actions to values.

    A linear map of the action is added to the normalised last hidden layer before its ReLU.

    The critic of a UAV with `team` reads the observations and actions of all UAVs (MADDPG, Lowe et
    al. 2017, NeurIPS). In the actors' losses, only a UAV's own action comes from its actor; the
    other actions are from the replay buffer.
    """

    def _add_output(self, groups: int, actions: int, inputs: int, **start: Any) -> None:
        self.action = StackedLinear(groups, actions, inputs, **start)
        self.value = StackedLinear(groups, inputs, 1, bound=FINAL_BOUND, **start)

    def forward(self, action: Tensor, taken: Tensor | None, *observations: Tensor) -> Tensor:
        """Maps an observation and actions to float32 [*batch, uavs, 1].

        Args:
            action: [*batch, uavs, actions].
            taken: the actions of the other UAVs, for `team`; `action` if None.
            observations: the tensors of an observation, [*batch, uavs, ...].
        """
        batch = action.shape[:-1]
        if self._team:
            others = self.grouping.of_team(action if taken is None else taken, len(batch))
            action = torch.cat((action, others[..., action.shape[-1] :]), -1)
        layers = [*self._hidden_layers(), self.action, self.value]
        inputs = self._encode(observations, batch), self.grouping.split(action, batch)
        return self.grouping.join(self._map(_to_value, layers, *inputs), batch)


def make_actor(
    observation_spec: Composite, action_spec: Composite, hidden: Sequence[int], **more: Any
) -> TensorDictModule:
    """Returns the actors of all UAVs, which map the observation to ("agents", "action").

    Args:
        observation_spec, action_spec: of the environment, batch size [num_envs].
        hidden: units of the hidden layers, 1 to 8 layers.
        more: `share_parameters` and `agent_index`, see `StackedActor`; `generator`.
    """
    network = _build(StackedActor, observation_spec, action_spec, hidden, **more)
    observed: Any = keys.observation_keys(observation_spec)
    return TensorDictModule(network, in_keys=observed, out_keys=[keys.ACTION])


def make_critic(
    observation_spec: Composite, action_spec: Composite, hidden: Sequence[int], **more: Any
) -> TensorDictModule:
    """Returns the critics of all UAVs, which write `STATE_ACTION_VALUE`.

    Arguments as for `make_actor`; `team` makes critics of the team.
    """
    network = _build(StackedCritic, observation_spec, action_spec, hidden, **more)
    reads: Any = [keys.ACTION, TAKEN, *keys.observation_keys(observation_spec)]
    return TensorDictModule(network, in_keys=reads, out_keys=[STATE_ACTION_VALUE])


def _build(kind: Any, observation: Composite, action: Composite, hidden: Any, **more: Any) -> Any:
    *_, uavs, actions = action[keys.ACTION].shape
    shapes = keys.observation_shapes(observation)
    return kind(uavs, shapes, actions, hidden, device=observation.device, **more)
