"""Encodes the tensors of an observation as one vector of features."""

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from emberlink.policies.networks.layers import StackedConv2d

CHANNELS = 16
"""channels of the convolutions"""
PICTURE_CHANNELS = (24, 32, 32)
"""channels of the convolutions of pictures"""
MAX_SIDE = 15
"""cells along a side of a window; a larger window is average-pooled before the convolutions"""


class WindowEncoder(nn.Module):
    """Applies two 3 x 3 convolutions, the second with stride 2, each followed by a ReLU.

    Args:
        groups: number of groups of weights.
        shape: [channels, W, W] of the window.
        start: see `layers.Start`.
    """

    def __init__(self, groups: int, shape: Sequence[int], **start: Any):
        super().__init__()
        channels, *sides = shape
        self.pool = -(-max(sides) // MAX_SIDE)
        self.first = StackedConv2d(groups, channels, CHANNELS, **start)
        self.second = StackedConv2d(groups, CHANNELS, CHANNELS, stride=2, **start)
        self.features = CHANNELS * math.prod((-(-side // self.pool) + 1) // 2 for side in sides)

    def forward(self, x: Tensor) -> Tensor:
        """Maps bool or float [groups, rows, channels, W, W] to float32 [groups, rows, features]."""
        groups = len(x)
        x = x.transpose(0, 1).flatten(1, 2).to(self.first.weight.dtype)
        if self.pool > 1:
            x = nn.functional.avg_pool2d(x, self.pool, ceil_mode=True)
        x = self.second(self.first(x).relu()).relu()
        return x.unflatten(1, (groups, -1)).transpose(0, 1).flatten(2)


class PictureEncoder(nn.Module):
    """Applies three 3 x 3 convolutions with stride 2 to each picture, each followed by a ReLU.

    Each picture has its own weights. With two pictures of 8 channels and 24 x 24 pixels, a row
    takes 1.2 million multiplications.

    Args:
        groups: number of groups of weights.
        shape: [pictures, channels, S, S]; bytes, which are scaled to [0, 1].
        start: see `layers.Start`.
    """

    def __init__(self, groups: int, shape: Sequence[int], **start: Any):
        super().__init__()
        pictures, channels, *sides = shape
        self.pictures = nn.ModuleList()
        for _ in range(pictures):
            layers, inputs = nn.ModuleList(), channels
            for outputs in PICTURE_CHANNELS:
                layers.append(StackedConv2d(groups, inputs, outputs, stride=2, **start))
                inputs = outputs
            self.pictures.append(layers)
        pixels = math.prod(-(-side // 2 ** len(PICTURE_CHANNELS)) for side in sides)
        self.features = pictures * PICTURE_CHANNELS[-1] * pixels

    def forward(self, x: Tensor) -> Tensor:
        """Maps uint8 [groups, rows, pictures, channels, S, S] to [groups, rows, features]."""
        groups, encoded, kind = len(x), [], x.device.type
        half = torch.is_autocast_enabled(kind)
        pictures: Any = self.pictures
        for layers, picture in zip(pictures, x.unbind(2), strict=True):
            # Bytes with the channels last: the convolutions are then a quarter faster on a CPU. A
            # picture of floats is copied, as it is the caller's.
            y = picture.transpose(0, 1).flatten(1, 2).contiguous(memory_format=torch.channels_last)
            dtype = torch.get_autocast_dtype(kind) if half else layers[0].weight.dtype
            y = y.to(dtype, copy=True).div_(255)
            for layer in layers:
                y = layer(y).relu_()
            encoded.append(y.unflatten(1, (groups, -1)).transpose(0, 1).flatten(2))
        return torch.cat(encoded, -1)


class ObservationEncoder(nn.Module):
    """Encodes windows and pictures of an observation and joins them to its vectors.

    Args:
        groups: number of groups of weights.
        shapes: shape of each tensor, per UAV: [features], [channels, W, W] or
            [pictures, channels, S, S].
        start: see `layers.Start`.
    """

    def __init__(self, groups: int, shapes: Sequence[Sequence[int]], **start: Any):
        super().__init__()
        self.parts, self.features = nn.ModuleList(), 0
        kinds: dict[int, Any] = {1: nn.Identity, 3: WindowEncoder, 4: PictureEncoder}
        for shape in shapes:
            part = kinds[len(shape)](groups, shape, **start)
            self.parts.append(part)
            self.features += shape[0] if len(shape) == 1 else part.features

    def forward(self, tensors: Sequence[Tensor]) -> Tensor:
        """Maps tensors [groups, rows, *shape] to float32 [groups, rows, features]."""
        features = [part(x) for part, x in zip(self.parts, tensors, strict=True)]
        return features[0] if len(features) == 1 else torch.cat(features, -1)
