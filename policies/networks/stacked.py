"""The paper's networks, with weights per UAV or per team, as batched products (section III.C)."""

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

MAX_BATCHED = 2**17
"""numbers of one group between two layers, half a megabyte, up to which a CPU computes all groups
at once; larger ones would not stay in its cache from one layer to the next"""
LAYER_NAMES = ("first", "second", "third", "fourth", "fifth", "sixth", "seventh", "eighth")
"""names of the hidden layers"""
FINAL_BOUND = 3e-3
"""of the initial weights of the last layer (Lillicrap et al. 2016, section 7)"""


class _Network(nn.Module):
    """The layers that actors and critics have in common: encoder and hidden layers.

    Args:
        uavs: UAVs of a team.
        observations: the shape of each tensor of an observation, per UAV: [features] or
            [channels, W, W].
        hidden: units of the hidden layers, at most eight; LayerNorm after each, ReLU in between.
        share_parameters: whether the UAVs of a team share their weights.
        device: of the weights.
        generator: of the initial weights; several make as many teams.
    """

    def __init__(
        self,
        uavs: int,
        observations: Sequence[Sequence[int]],
        hidden: Sequence[int],
        *,
        share_parameters: bool = False,
        device: torch.device | str | None = None,
        generator: Generators = None,
    ):
        super().__init__()
        if not 1 <= len(hidden) <= len(LAYER_NAMES):
            raise ValueError(f"hidden={list(hidden)}: 1 to {len(LAYER_NAMES)} layers are possible")
        self.grouping = Grouping(uavs, len(team_generators(generator)), shared=share_parameters)
        self.names, self.widest = LAYER_NAMES[: len(hidden)], max(hidden)
        self._dims = len(observations[0])
        groups = self.grouping.groups
        start: dict[str, Any] = {"device": device, "generator": generator}
        self.encoder = ObservationEncoder(groups, observations, **start)
        inputs = self.encoder.features
        for name, units in zip(self.names, hidden, strict=True):
            self.add_module(name, StackedLinear(groups, inputs, units, **start))
            self.add_module(f"{name}_norm", StackedLayerNorm(groups, units, device=device))
            inputs = units

    def _hidden_layers(self) -> list[Any]:
        """Returns linear map and norm of each hidden layer in turn."""
        return [getattr(self, name + kind) for name in self.names for kind in ("", "_norm")]

    def _encode(self, observations: Sequence[Tensor], batch: torch.Size) -> list[Tensor]:
        tensors = [self.grouping.split(x, batch) for x in observations]
        return self._parts(self.encoder(tensors))

    def _parts(self, x: Tensor) -> list[Tensor]:
        """Takes an input apart for `apply_layers`, [groups, rows, features].

        Returns:
            The input itself in a list, or the [rows, features] of each group.
        """
        at_once = x.is_cuda or x.shape[1] * self.widest < MAX_BATCHED
        return [x] if at_once else list(x.unbind(0))

    def _join(self, parts: list[Tensor], batch: torch.Size) -> Tensor:
        """Puts the result of `apply_layers` together: [*batch, features]."""
        x = parts[0] if parts[0].ndim == 3 else torch.stack(parts)
        return self.grouping.join(x, batch)


class StackedActor(_Network):
    """Observation -> hidden layers -> action; ReLU after each hidden layer, tanh at the end.

    Args:
        uavs, observations: see `_Network`.
        actions: numbers in an action.
        hidden, share_parameters: see `_Network`.
        start: `device` and `generator` of `_Network`.
    """

    def __init__(
        self,
        uavs: int,
        observations: Sequence[Sequence[int]],
        actions: int,
        hidden: Sequence[int] = (400, 300),
        *,
        share_parameters: bool = False,
        **start: Any,
    ):
        super().__init__(uavs, observations, hidden, share_parameters=share_parameters, **start)
        groups, last = self.grouping.groups, hidden[-1]
        self.action = StackedLinear(groups, last, actions, bound=FINAL_BOUND, **start)

    def forward(self, *observations: Tensor) -> Tensor:
        """The tensors of an observation, [*batch, uavs, ...] -> [*batch, uavs, actions]."""
        batch = observations[0].shape[: -self._dims]
        layers = [*self._hidden_layers(), self.action]
        return self._join(apply_layers(_action, layers, self._encode(observations, batch)), batch)


class StackedCritic(_Network):
    """Observation and action -> value.

    The action enters late: a linear map of it is added to the normalised last hidden layer before
    its ReLU. Arguments as `StackedActor`.
    """

    def __init__(
        self,
        uavs: int,
        observations: Sequence[Sequence[int]],
        actions: int,
        hidden: Sequence[int] = (400, 300),
        *,
        share_parameters: bool = False,
        **start: Any,
    ):
        super().__init__(uavs, observations, hidden, share_parameters=share_parameters, **start)
        groups, last = self.grouping.groups, hidden[-1]
        self.action = StackedLinear(groups, actions, last, **start)
        self.value = StackedLinear(groups, last, 1, bound=FINAL_BOUND, **start)
        self._cache = FeatureCache()

    def forward(self, *inputs: Tensor) -> Tensor:
        """The tensors of an observation, and the action, -> float32 [*batch, uavs, 1]."""
        *observations, action = inputs
        batch = action.shape[:-1]

        def compute(observations: Sequence[Tensor]) -> list[Tensor]:
            return apply_layers(_features, self._hidden_layers(), self._encode(observations, batch))

        first: Any = self.first
        features = self._cache.get(observations, first.weight, compute)
        actions = self._parts(self.grouping.split(action, batch))
        values = apply_layers(_value, [self.action, self.value], actions, features)
        return self._join(values, batch)

    def sharing(self) -> AbstractContextManager[None]:
        """Computes what does not depend on the action once per observation, see `FeatureCache`."""
        return self._cache.active()


def apply_layers(
    function: Callable[..., Tensor], layers: Sequence[Any], *inputs: list[Tensor]
) -> list[Tensor]:
    """Applies a function to the layers and the parts of its inputs.

    Args:
        function: of a list of layers and one part of each input.
        layers: stacked layers.
        inputs: each in as many parts: one with all groups, or one per group.
    """
    if inputs[0][0].ndim == 3:
        return [function(layers, *(parts[0] for parts in inputs))]
    by_group = zip(*(layer.per_group() for layer in layers), strict=True)
    return [function(*group) for group in zip(by_group, *inputs, strict=True)]


# ReLU and tanh overwrite the output of the layer before: no gradient needs it.


def _features(layers: Sequence[Layer], x: Tensor) -> Tensor:
    """The last hidden layer before its ReLU; layers: linear map and norm in turn."""
    *before, last, last_norm = layers
    for linear, norm in zip(before[::2], before[1::2], strict=True):
        x = norm(linear(x)).relu_()
    return last_norm(last(x))


def _action(layers: Sequence[Layer], x: Tensor) -> Tensor:
    *hidden, last = layers
    return last(_features(hidden, x).relu_()).tanh_()


def _value(layers: Sequence[Layer], action: Tensor, features: Tensor) -> Tensor:
    from_action, last = layers
    return last((features + from_action(action)).relu_())
