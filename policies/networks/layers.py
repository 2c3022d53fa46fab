"""Layers with separate weights for each group of inputs, computed as one batched operation.

The first dimension of every weight is the group: a UAV, or the team if its UAVs share weights.
"""

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

Layer = Callable[[Tensor], Tensor]
Start = dict[str, Any]
"""`device` of the weights and `generator` of their initial values, on the CPU; None for global"""


def uniform_weights(
    *shape: int,
    bound: float,
    device: torch.device | str | None = None,
    generator: torch.Generator | None = None,
) -> nn.Parameter:
    """Draws weights uniformly from [-bound, bound], on the CPU: equal on all devices."""
    weights = torch.empty(shape, dtype=torch.float32).uniform_(-bound, bound, generator=generator)
    return nn.Parameter(weights.to(device))


def orthogonal_weights(
    groups: int,
    *shape: int,
    gain: float,
    device: torch.device | str | None = None,
    generator: torch.Generator | None = None,
) -> nn.Parameter:
    """Draws weights that are orthogonal times `gain` in each group (Saxe et al. 2014, ICLR)."""
    weights = [
        nn.init.orthogonal_(torch.empty(shape, dtype=torch.float32), gain, generator=generator)
        for _ in range(groups)
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
        start: see `Start`.
    """

    def __init__(
        self,
        groups: int,
        inputs: int,
        outputs: int,
        *,
        bound: float | None = None,
        gain: float | None = None,
        **start: Any,
    ):
        super().__init__()
        if gain is None:
            bound = 1 / math.sqrt(inputs) if bound is None else bound
            self.weight = uniform_weights(groups, inputs, outputs, bound=bound, **start)
            self.bias = uniform_weights(groups, 1, outputs, bound=bound, **start)
        else:
            self.weight = orthogonal_weights(groups, inputs, outputs, gain=gain, **start)
            self.bias = nn.Parameter(torch.zeros_like(self.weight[:, :1]))

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
        ones = torch.ones(groups, 1, features, dtype=torch.float32, device=device)
        self.weight, self.bias = nn.Parameter(ones), nn.Parameter(torch.zeros_like(ones))

    def forward(self, x: Tensor) -> Tensor:
        """Maps [groups, rows, features] to the same shape."""
        normal = nn.functional.layer_norm(x, x.shape[-1:])
        return torch.addcmul(self.bias, normal, self.weight)

    def per_group(self) -> list[Layer]:
        """Returns the layer of each group, which maps [rows, features] to the same shape."""
        norm = nn.functional.layer_norm
        groups = zip(self.weight.squeeze(1), self.bias.squeeze(1), strict=True)
        return [lambda x, w=weight, b=bias: norm(x, w.shape, w, b) for weight, bias in groups]


class StackedConv2d(nn.Module):
    """Applies a 3 x 3 convolution per group, with a zero padding of one cell.

    Args:
        groups: number of groups.
        inputs, outputs: number of channels of the input and of the output.
        stride: stride along both sides.
        start: see `Start`; the bound of the weights is 1 / sqrt(9 * inputs).
    """

    def __init__(self, groups: int, inputs: int, outputs: int, *, stride: int = 1, **start: Any):
        super().__init__()
        self.stride, bound = stride, 1 / math.sqrt(9 * inputs)
        self.weight = uniform_weights(groups, outputs, inputs, 3, 3, bound=bound, **start)
        self.bias = uniform_weights(groups, outputs, bound=bound, **start)

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
