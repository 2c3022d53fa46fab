"""Layers with separate weights per group of inputs, computed as one batched operation.

The first dimension of every weight is the group. A group is a UAV, or a team whose UAVs share their
weights (see `grouping`).
"""

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

Layer = Callable[[Tensor], Tensor]
Generators = torch.Generator | Sequence[torch.Generator] | None
"""of the initial weights: one generator, or one per team; see `team_generators`"""


def team_generators(generator: Generators) -> Sequence[torch.Generator | None]:
    """Returns the generator of each team."""
    return generator if isinstance(generator, Sequence) else [generator]


def initial_weights(
    groups: int,
    *shape: int,
    bound: float,
    device: torch.device | str | None = None,
    generator: Generators = None,
) -> nn.Parameter:
    """Returns weights uniform in [-bound, bound], [groups, *shape].

    They are drawn on the CPU, so that a seed gives the same weights on every device. Each team's
    generator draws the weights of the team's groups.
    """
    generators = team_generators(generator)
    teams = [
        torch.empty(groups // len(generators), *shape).uniform_(-bound, bound, generator=of_team)
        for of_team in generators
    ]
    return nn.Parameter(torch.cat(teams).to(device))


class StackedLinear(nn.Module):
    """A linear map per group.

    Args:
        groups: number of groups.
        inputs, outputs: features of the input and of the output.
        bound: weights and biases start uniform in [-bound, bound]; 1 / sqrt(inputs) if None, as
            in the DDPG paper (Lillicrap et al. 2016, section 7).
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
        device: torch.device | str | None = None,
        generator: Generators = None,
    ):
        super().__init__()
        bound = 1 / math.sqrt(inputs) if bound is None else bound
        start = {"bound": bound, "device": device, "generator": generator}
        self.weight = initial_weights(groups, inputs, outputs, **start)
        self.bias = initial_weights(groups, 1, outputs, **start)

    def forward(self, x: Tensor) -> Tensor:
        """[groups, rows, inputs] -> [groups, rows, outputs]."""
        return torch.baddbmm(self.bias, x, self.weight)

    def per_group(self) -> list[Layer]:
        """Returns the layer of each group, [rows, inputs] -> [rows, outputs]."""
        groups = zip(self.weight.unbind(0), self.bias.squeeze(1).unbind(0), strict=True)
        return [lambda x, w=weight, b=bias: torch.addmm(b, x, w) for weight, bias in groups]


class StackedLayerNorm(nn.Module):
    """Layer normalisation (Ba et al. 2016) with a scale and a shift per group."""

    def __init__(self, groups: int, features: int, *, device: torch.device | str | None = None):
        super().__init__()
        self.weight = nn.Parameter(torch.ones(groups, 1, features, device=device))
        self.bias = nn.Parameter(torch.zeros(groups, 1, features, device=device))

    def forward(self, x: Tensor) -> Tensor:
        """[groups, rows, features] -> the same."""
        normal = nn.functional.layer_norm(x, x.shape[-1:])
        return torch.addcmul(self.bias, normal, self.weight)

    def per_group(self) -> list[Layer]:
        """Returns the layer of each group, [rows, features] -> the same."""
        norm = nn.functional.layer_norm
        weights, biases = self.weight.squeeze(1).unbind(0), self.bias.squeeze(1).unbind(0)
        groups = zip(weights, biases, strict=True)
        return [lambda x, w=weight, b=bias: norm(x, w.shape, w, b) for weight, bias in groups]


class StackedConv2d(nn.Module):
    """A 3 x 3 convolution per group, with a margin of one cell.

    Args:
        groups: number of groups.
        inputs, outputs: channels of the input and of the output.
        stride: of the output's cells.
        device: of the weights.
        generator: of the initial weights, which start as `StackedLinear`'s.
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
        """[rows, groups * inputs, H, W] -> [rows, groups * outputs, H / stride, W / stride]."""
        return nn.functional.conv2d(
            x,
            self.weight.flatten(0, 1),
            self.bias.flatten(),
            stride=self.stride,
            padding=1,
            groups=len(self.weight),
        )
