"""The paper's networks, one per UAV, as one batched product (section III.C; docs/setups.md).

A stack holds the weights of all UAVs in tensors whose first dimension is the UAV: nothing is
shared, no gradient crosses, and one launch serves all. Several teams that train side by side, one
per seed, are a longer stack: team 0's UAVs first.
"""

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

Layer = Callable[[Tensor], Tensor]
Generators = torch.Generator | Sequence[torch.Generator] | None
"""of initial weights: one for all, or one per team of a stack that shares the UAVs out in order"""


def of_teams(generator: Generators) -> Sequence[torch.Generator | None]:
    """The generator of each team."""
    return generator if isinstance(generator, Sequence) else [generator]


_LARGE = 2**17
"""numbers of one UAV between two layers, half a megabyte"""


class StackedLinear(nn.Module):
    """A linear map per UAV.

    Args:
        uavs: how many.
        inputs, outputs: features per UAV.
        bound: weights and biases start uniform in [-bound, bound]; 1 / sqrt(inputs) if None, as
            in the DDPG paper (Lillicrap et al. 2016, section 7).
        device: of the weights.
        generator: of the initial weights.
    """

    def __init__(
        self,
        uavs: int,
        inputs: int,
        outputs: int,
        *,
        bound: float | None = None,
        device: torch.device | str | None = None,
        generator: Generators = None,
    ):
        super().__init__()
        bound = 1 / math.sqrt(inputs) if bound is None else bound
        generators = of_teams(generator)
        team = uavs // len(generators)

        def start(*shape: int) -> nn.Parameter:
            # Drawn on the CPU, so that a seed means the same weights on every device.
            values = [
                torch.empty(team, *shape).uniform_(-bound, bound, generator=one)
                for one in generators
            ]
            return nn.Parameter(torch.cat(values).to(device))

        self.weight = start(inputs, outputs)
        self.bias = start(1, outputs)

    def forward(self, x: Tensor) -> Tensor:
        """[uavs, batch, inputs] -> [uavs, batch, outputs]."""
        return torch.baddbmm(self.bias, x, self.weight)

    def each(self) -> list[Layer]:
        """One layer per UAV, [batch, inputs] -> [batch, outputs]."""
        uavs = zip(self.weight.unbind(0), self.bias.unbind(0), strict=True)
        return [lambda x, w=weight, b=bias: torch.addmm(b, x, w) for weight, bias in uavs]


class StackedLayerNorm(nn.Module):
    """Layer normalisation (Ba et al. 2016) with a scale and a shift per UAV."""

    def __init__(self, uavs: int, features: int, *, device: torch.device | str | None = None):
        super().__init__()
        self.weight = nn.Parameter(torch.ones(uavs, 1, features, device=device))
        self.bias = nn.Parameter(torch.zeros(uavs, 1, features, device=device))

    def forward(self, x: Tensor) -> Tensor:
        """[uavs, batch, features] -> the same."""
        normal = nn.functional.layer_norm(x, x.shape[-1:])
        return torch.addcmul(self.bias, normal, self.weight)

    def each(self) -> list[Layer]:
        """One layer per UAV, [batch, features] -> the same."""
        norm = nn.functional.layer_norm
        uavs = zip(self.weight.unbind(0), self.bias.unbind(0), strict=True)
        return [lambda x, w=weight[0], b=bias[0]: norm(x, w.shape, w, b) for weight, bias in uavs]


class _Trunk(nn.Module):
    """Observation -> first -> second hidden layer, LayerNorm after each, ReLU in between."""

    def __init__(
        self,
        uavs: int,
        features: int,
        hidden: tuple[int, int],
        device: torch.device | str | None,
        generator: Generators,
    ):
        super().__init__()
        self.uavs, self.widest = uavs, max(hidden)
        first, second = hidden
        self.first = StackedLinear(uavs, features, first, device=device, generator=generator)
        self.first_norm = StackedLayerNorm(uavs, first, device=device)
        self.second = StackedLinear(uavs, first, second, device=device, generator=generator)
        self.second_norm = StackedLayerNorm(uavs, second, device=device)

    def by_uav(self, x: Tensor) -> Tensor:
        """[..., uavs, features] -> [uavs, batch, features].

        Where x has the UAVs of one team only, its first dimension holds the teams' environments,
        team 0's first, and each team is read from its own.
        """
        x = x.flatten(0, -3) if x.ndim > 2 else x.unsqueeze(0)
        teams = self.uavs // x.shape[-2]
        return x.unflatten(0, (teams, -1)).transpose(1, 2).flatten(0, 1)

    def by_batch(self, x: Tensor, shape: torch.Size) -> Tensor:
        """The other way: [uavs, batch, features] -> [*shape, features]."""
        return x.unflatten(0, (-1, shape[-1])).transpose(1, 2).reshape(*shape, x.shape[-1])

    def apply_all(
        self,
        network: Callable[..., Tensor],
        layers: Sequence[StackedLinear | StackedLayerNorm],
        *inputs: Tensor,
    ) -> Tensor:
        """All UAVs' networks on their inputs, [uavs, batch, features] each.

        At once; but on a CPU one after another where the numbers of all would not stay in its
        cache from one layer to the next.

        Args:
            network: of one UAV or of a stack: layers, then inputs.
            layers: what `network` is given.
            inputs: what it is applied to.
        """
        first = inputs[0]
        if first.is_cuda or first.shape[1] * self.widest < _LARGE:
            return network(*layers, *inputs)
        each = zip(*(layer.each() for layer in layers), *inputs, strict=True)
        return torch.stack([network(*one) for one in each])


class StackedActor(_Trunk):
    """Observation -> 400 -> 300 -> action; LayerNorm and ReLU after each, tanh at the end.

    Args:
        uavs: how many.
        features: numbers in an observation.
        actions: numbers in an action.
        hidden: sizes of the two hidden layers.
        device: of the weights.
        generator: of the initial weights.
    """

    def __init__(
        self,
        uavs: int,
        features: int,
        actions: int,
        hidden: tuple[int, int] = (400, 300),
        *,
        device: torch.device | str | None = None,
        generator: Generators = None,
    ):
        super().__init__(uavs, features, hidden, device, generator)
        self.action = StackedLinear(
            uavs, hidden[1], actions, bound=3e-3, device=device, generator=generator
        )

    def forward(self, observation: Tensor) -> Tensor:
        """float32 [..., uavs, features] -> [..., uavs, actions] in (-1, 1)."""
        layers = self.first, self.first_norm, self.second, self.second_norm, self.action
        action = self.apply_all(_action, layers, self.by_uav(observation))
        return self.by_batch(action, observation.shape[:-1])


class StackedCritic(_Trunk):
    """Observation and action -> value.

    The action enters late: a linear map of it is added to the normalised second layer before
    its ReLU. Arguments as `StackedActor`.
    """

    def __init__(
        self,
        uavs: int,
        features: int,
        actions: int,
        hidden: tuple[int, int] = (400, 300),
        *,
        device: torch.device | str | None = None,
        generator: Generators = None,
    ):
        super().__init__(uavs, features, hidden, device, generator)
        self.action = StackedLinear(uavs, actions, hidden[1], device=device, generator=generator)
        self.value = StackedLinear(
            uavs, hidden[1], 1, bound=3e-3, device=device, generator=generator
        )

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        """float32 [..., uavs, features] and [..., uavs, actions] -> [..., uavs, 1]."""
        trunk = self.first, self.first_norm, self.second, self.second_norm
        inputs = self.by_uav(observation), self.by_uav(action)
        value = self.apply_all(_value, (*trunk, self.action, self.value), *inputs)
        return self.by_batch(value, observation.shape[:-1])


# In place of what a layer made: nothing else needs it, not even its own gradient.


def _action(
    first: Layer, first_norm: Layer, second: Layer, second_norm: Layer, last: Layer, x: Tensor
) -> Tensor:
    x = first_norm(first(x)).relu_()
    x = second_norm(second(x)).relu_()
    return last(x).tanh_()


def _value(
    first: Layer,
    first_norm: Layer,
    second: Layer,
    second_norm: Layer,
    from_action: Layer,
    last: Layer,
    x: Tensor,
    action: Tensor,
) -> Tensor:
    x = first_norm(first(x)).relu_()
    x = second_norm(second(x)).add_(from_action(action)).relu_()
    return last(x)
