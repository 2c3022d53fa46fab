"""The actor and critic of the paper (section III.C), with weights per UAV or per team."""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import Any

import torch
from torch import Tensor, nn

from emberlink.policies.networks.encoders import ObservationEncoder
from emberlink.policies.networks.feature_cache import FeatureCache
from emberlink.policies.networks.grouping import Grouping
from emberlink.policies.networks.layers import (
    Generators,
    Layer,
    StackedLayerNorm,
    StackedLinear,
    team_generators,
)
from emberlink.policies.networks.memory.registry import find
from emberlink.policies.settings import PolicyConfig

MAX_BATCHED = 2**17
"""Maximum size of a group's activations for which a CPU computes all groups in one batched product.
Larger activations (over 0.5 MB) would not stay in its cache from one layer to the next."""
LAYER_NAMES = ("first", "second", "third", "fourth", "fifth", "sixth", "seventh", "eighth")
"""names of the hidden layers"""
FINAL_BOUND = 3e-3
"""bound of the initial weights of the last layer (Lillicrap et al. 2016, section 7)"""


class StackedNetwork(nn.Module):
    """The common part of actors and critics: an encoder and hidden layers.

    Args:
        uavs: number of UAVs in a team.
        observations: shape of each tensor of an observation, per UAV: [features],
            [channels, W, W] or [pictures, channels, S, S].
        actions: number of components of an action.
        hidden: units of the hidden layers, 1 to 8 layers. Each is followed by a LayerNorm.
        share_parameters: whether the UAVs of a team share their weights.
        policy: the memory, and whether the index of the UAV is an input, too.
        team: whether the inputs of a UAV are the observations and actions of its whole team.
        device: of the weights.
        generator: of the initial weights; several generators create the same number of teams.

    Raises:
        ValueError: there are no hidden layers or more than 8, or an observation has an unsupported
            shape.
    """

    def __init__(
        self,
        uavs: int,
        observations: Sequence[Sequence[int]],
        actions: int,
        hidden: Sequence[int] = (400, 300),
        *,
        share_parameters: bool = False,
        policy: PolicyConfig | None = None,
        team: bool = False,
        device: torch.device | str | None = None,
        generator: Generators = None,
    ):
        super().__init__()
        policy = policy or PolicyConfig()
        if not 1 <= len(hidden) <= len(LAYER_NAMES):
            raise ValueError(f"hidden={list(hidden)}: 1 to {len(LAYER_NAMES)} layers are possible")
        self.grouping = Grouping(uavs, len(team_generators(generator)), shared=share_parameters)
        self.names, self.widest = LAYER_NAMES[: len(hidden)], max(hidden)
        self._dims, self._indexed, self._team = len(observations[0]), policy.agent_index, team
        if team:
            observations = [(n * uavs, *sides) for n, *sides in observations]
            actions *= uavs
        if policy.agent_index:
            observations = [(observations[0][0] + uavs,), *observations[1:]]
        groups = self.grouping.groups
        start: dict[str, Any] = {"device": device, "generator": generator}
        self.encoder = ObservationEncoder(groups, observations, **start)
        self.memory = find(policy.memory)(groups, self.encoder.features, policy, **start)
        inputs = self.memory.features
        for name, units in zip(self.names, hidden, strict=True):
            self.add_module(name, StackedLinear(groups, inputs, units, **start))
            self.add_module(f"{name}_norm", StackedLayerNorm(groups, units, device=device))
            inputs = units
        self._add_output(actions, inputs, **start)

    def _add_output(self, actions: int, inputs: int, **start: Any) -> None:
        """Adds the layers after the hidden ones, which have `inputs` units at the end."""
        raise NotImplementedError

    def _hidden_layers(self) -> list[Any]:
        """Returns the linear map and the LayerNorm of each hidden layer, in order."""
        return [getattr(self, name + kind) for name in self.names for kind in ("", "_norm")]

    def _encode(self, observations: Sequence[Tensor], batch: torch.Size) -> list[Tensor]:
        if self._team:
            observations = [self.grouping.of_team(x, len(batch)) for x in observations]
        if self._indexed:
            observations = [self.grouping.with_index(observations[0]), *observations[1:]]
        tensors = [self.grouping.split(x, batch) for x in observations]
        return self._parts(self.encoder(tensors))

    def _parts(self, x: Tensor) -> list[Tensor]:
        """Splits an input [groups, rows, features] for `apply_layers`.

        Returns:
            The whole input as one part, or a part [rows, features] for each group.
        """
        at_once = x.is_cuda or x.shape[1] * self.widest < MAX_BATCHED
        return [x] if at_once else list(x.unbind(0))

    def _join(self, parts: list[Tensor], batch: torch.Size) -> Tensor:
        """Joins the parts of a result of `apply_layers`: [*batch, features]."""
        x = parts[0] if parts[0].ndim == 3 else torch.stack(parts)
        return self.grouping.join(x, batch)


class StackedActor(StackedNetwork):
    """Maps observations to actions in [-1, 1].

    A ReLU follows each hidden layer, and a tanh the last layer. Arguments are those of
    `StackedNetwork`.
    """

    def _add_output(self, actions: int, inputs: int, **start: Any) -> None:
        groups = self.grouping.groups
        self.action = StackedLinear(groups, inputs, actions, bound=FINAL_BOUND, **start)

    def forward(self, *observations: Tensor) -> Tensor:
        """Maps the tensors of an observation, [*batch, uavs, ...], to [*batch, uavs, actions]."""
        batch = observations[0].shape[: -self._dims]
        layers = [*self._hidden_layers(), self.action]
        return self._join(apply_layers(to_action, layers, self._encode(observations, batch)), batch)


class StackedCritic(StackedNetwork):
    """Maps observations and actions to values.

    A linear map of the action is added to the normalised last hidden layer before its ReLU.
    Arguments are those of `StackedNetwork`.
    """

    def _add_output(self, actions: int, inputs: int, **start: Any) -> None:
        groups = self.grouping.groups
        self.action = StackedLinear(groups, actions, inputs, **start)
        self.value = StackedLinear(groups, inputs, 1, bound=FINAL_BOUND, **start)
        self._cache = FeatureCache()

    def forward(self, *inputs: Tensor) -> Tensor:
        """Maps the tensors of an observation and then the action to float32 [*batch, uavs, 1]."""
        *observations, action = inputs
        batch = action.shape[:-1]

        def compute(observations: Sequence[Tensor]) -> list[Tensor]:
            return apply_layers(
                to_features, self._hidden_layers(), self._encode(observations, batch)
            )

        first: Any = self.first
        features = self._cache.get(observations, first.weight, compute)
        actions = self._parts(self.grouping.split(action, batch))
        values = apply_layers(to_value, [self.action, self.value], actions, features)
        return self._join(values, batch)

    def sharing(self) -> AbstractContextManager[None]:
        """Computes features once per observation within a `with` block, see `FeatureCache`."""
        return self._cache.active()


def apply_layers(
    function: Callable[..., Tensor], layers: Sequence[Any], *inputs: list[Tensor]
) -> list[Tensor]:
    """Applies a function to all groups at once, or to one group after another.

    Args:
        function: function of a list of layers and one part of each input.
        layers: stacked layers.
        inputs: the parts of each input: one part with all groups, or one part per group.
    """
    if inputs[0][0].ndim == 3:
        return [function(layers, *(parts[0] for parts in inputs))]
    by_group = zip(*(layer.per_group() for layer in layers), strict=True)
    return [function(*group) for group in zip(by_group, *inputs, strict=True)]


# ReLU and tanh are computed in place: no gradient needs the output of the layer before.


def to_features(layers: Sequence[Layer], x: Tensor) -> Tensor:
    """Returns the last hidden layer before its ReLU, given a linear map and a norm per layer."""
    *before, last, last_norm = layers
    for linear, norm in zip(before[::2], before[1::2], strict=True):
        x = norm(linear(x)).relu_()
    return last_norm(last(x))


def to_action(layers: Sequence[Layer], x: Tensor) -> Tensor:
    *hidden, last = layers
    return last(to_features(hidden, x).relu_()).tanh_()


def to_value(layers: Sequence[Layer], action: Tensor, features: Tensor) -> Tensor:
    from_action, last = layers
    return last((features + from_action(action)).relu_())
