"""Layers with separate weights for each group of inputs, computed as one batched operation.

The first dimension of every weight is the group: a UAV, or a team whose UAVs share their weights
(see `grouping`).
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

Layer = Callable[[Tensor], Tensor]
Generators = torch.Generator | Sequence[torch.Generator] | None
"""generators of the initial weights: one, or one per team; None for the global generator"""


def team_generators(generator: Generators) -> Sequence[torch.Generator | None]:
    """Returns the generator of each team; a single generator is one team."""
    return generator if isinstance(generator, Sequence) else [generator]


def initial_weights(
    groups: int,
    *shape: int,
    bound: float,
    device: torch.device | str | None = None,
    generator: Generators = None,
) -> nn.Parameter:
    """Draws weights [groups, *shape] uniformly from [-bound, bound].

    Weights are drawn on the CPU, so a seed gives the same weights on every device. The generator of
    a team draws the weights of its groups.
    """
    generators = team_generators(generator)
    teams = [
        torch.empty(groups // len(generators), *shape, dtype=torch.float32).uniform_(
            -bound, bound, generator=of_team
        )
        for of_team in generators
    ]
    return nn.Parameter(torch.cat(teams).to(device))


def orthogonal_weights(
    groups: int,
    *shape: int,
    gain: float,
    device: torch.device | str | None = None,
    generator: Generators = None,
) -> nn.Parameter:
    """Draws weights [groups, *shape] that are orthogonal in each group (Saxe et al. 2014, ICLR).

    Args:
        groups, shape, device, generator: as for `initial_weights`.
        gain: factor of the orthogonal matrix.
    """
    generators = team_generators(generator)
    weights = [
        nn.init.orthogonal_(torch.empty(shape, dtype=torch.float32), gain, generator=of_team)
        for of_team in generators
        for _ in range(groups // len(generators))
    ]
    return nn.Parameter(torch.stack(weights).to(device))


class StackedLinear(nn.Module):
    """Applies a linear map per group.

    Args:
        groups: number of groups.
        inputs, outputs: number of features of the input and of the output.
        bound: weights and biases are initialised uniformly in [-bound, bound]; if None, 1 /
            sqrt(inputs), as in the DDPG paper (Lillicrap et al. 2016, section 7).
        gain: if given, weights are orthogonal with this factor instead, and biases are 0.
        device: of the weights.
        generator: of the initial weights.
    """

    def __init__(
        self,
        groups: int,
        inputs: int,
        outputs: int,
        *,
        bound: float | None = None,
        gain: float | None = None,
        device: torch.device | str | None = None,
        generator: Generators = None,
    ):
        super().__init__()
        if gain is not None:
            more: Any = {"device": device, "generator": generator}
            self.weight = orthogonal_weights(groups, inputs, outputs, gain=gain, **more)
            self.bias = nn.Parameter(
                torch.zeros(groups, 1, outputs, dtype=torch.float32, device=device)
            )
            return
        bound = 1 / math.sqrt(inputs) if bound is None else bound
        start = {"bound": bound, "device": device, "generator": generator}
        self.weight = initial_weights(groups, inputs, outputs, **start)
        self.bias = initial_weights(groups, 1, outputs, **start)

    def forward(self, x: Tensor) -> Tensor:
        """Maps [groups, rows, inputs] to [groups, rows, outputs]."""
        return torch.baddbmm(self.bias, x, self.weight)

    def per_group(self) -> list[Layer]:
        """Returns the layer of each group, which maps [rows, inputs] to [rows, outputs]."""
        groups = zip(self.weight.unbind(0), self.bias.squeeze(1).unbind(0), strict=True)
        return [lambda x, w=weight, b=bias: torch.addmm(b, x, w) for weight, bias in groups]


class StackedLayerNorm(nn.Module):
    """Applies layer normalisation (Ba et al. 2016) with a scale and a shift per group."""

    def __init__(self, groups: int, features: int, *, device: torch.device | str | None = None):
        super().__init__()
        self.weight = nn.Parameter(
            torch.ones(groups, 1, features, dtype=torch.float32, device=device)
        )
        self.bias = nn.Parameter(
            torch.zeros(groups, 1, features, dtype=torch.float32, device=device)
        )

    def forward(self, x: Tensor) -> Tensor:
        """Maps [groups, rows, features] to the same shape."""
        normal = nn.functional.layer_norm(x, x.shape[-1:])
        return torch.addcmul(self.bias, normal, self.weight)

    def per_group(self) -> list[Layer]:
        """Returns the layer of each group, which maps [rows, features] to the same shape."""
        norm = nn.functional.layer_norm
        weights, biases = self.weight.squeeze(1).unbind(0), self.bias.squeeze(1).unbind(0)
        groups = zip(weights, biases, strict=True)
        return [lambda x, w=weight, b=bias: norm(x, w.shape, w, b) for weight, bias in groups]


class StackedConv2d(nn.Module):
    """Applies a 3 x 3 convolution per group, with a zero padding of one cell.

    Args:
        groups: number of groups.
        inputs, outputs: number of channels of the input and of the output.
        stride: stride along both sides.
        device: of the weights.
        generator: of the initial weights; their bound is 1 / sqrt(9 * inputs).
    """

    def __init__(
        self,
        groups: int,
        inputs: int,
        outputs: int,
        *,
        stride: int = 1,
        device: torch.device | str | None = None,
        generator: Generators = None,
    ):
        super().__init__()
        self.stride = stride
        start = {"bound": 1 / math.sqrt(9 * inputs), "device": device, "generator": generator}
        self.weight = initial_weights(groups, outputs, inputs, 3, 3, **start)
        self.bias = initial_weights(groups, outputs, **start)

    def forward(self, x: Tensor) -> Tensor:
        """Maps [rows, groups * inputs, H, W] to [rows, groups * outputs, H/stride, W/stride]."""
        return nn.functional.conv2d(
            x,
            self.weight.flatten(0, 1),
            self.bias.flatten(),
            stride=self.stride,
            padding=1,
            groups=len(self.weight),
        )
