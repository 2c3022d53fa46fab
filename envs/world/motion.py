"""Moves UAVs and draws points: pure functions of tensors.

`move` computes in float64, so that a scalar reference implementation with the same float32
positions gives the same result.
"""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from emberlink.envs.utils import counter_rng
from emberlink.envs.utils.errors import UserError

_BELOW_ONE = 1 - 2**-22  # so that rounding does not carry a UAV across the edge of the box


def corners(low: Sequence[float], high: Sequence[float]) -> tuple[Tensor, Tensor]:
    """Returns two corners of the box, float64 [3] each, rounded to float32.

    Positions are float32: without rounding, a UAV at an altitude of 3.3 could be outside a box with
    a corner at 3.3.
    """
    both = torch.tensor([low, high], dtype=torch.float32).double()
    return both[0], both[1]


def move(
    position: Tensor, action: Tensor, *, displacement: float, low: Tensor, high: Tensor
) -> tuple[Tensor, Tensor]:
    """Moves all UAVs at once and clips their positions to the box.

    Args:
        position: [..., 3], cells; exactly representable in float32.
        action: float32 [..., 3]; components are clipped to [-1, 1], and NaN counts as 0.
        displacement: cells per unit of action.
        low, high: float64 [3], the corners of the box, from `corners`.

    Returns:
        The new positions, float32 [..., 3], and the axes along which the move would have left the
        box, bool [..., 3].
    """
    clipped = action.nan_to_num(0.0).clamp_(-1, 1)
    wanted = torch.add(position.double(), clipped, alpha=displacement)
    inside = wanted.clamp(low, high)
    return inside.float(), inside != wanted


def towards(way: Tensor, stride: float) -> Tensor:
    """Returns the action that flies straight along a way at full speed and stops at its end.

    Args:
        way: float [..., k], cells along each axis.
        stride: cells that a component of 1 leads.

    Returns:
        float32 [..., k].
    """
    step = way / stride
    return (step / step.abs().amax(-1, keepdim=True).clamp(min=1)).float() * _BELOW_ONE


def random_points(key: Tensor, count: int, low: Tensor, high: Tensor) -> Tensor:
    """Draws uniform points in the box, float32 [..., count, 3], given keys int64 [...]."""
    unit = counter_rng.uniform(key, count * 3).unflatten(-1, (count, 3))
    points = low.float() + unit * (high - low).float()
    return torch.minimum(points, high.float())  # rounding may exceed the upper corner


def given_points(given: Any, shape: Sequence[int], low: Tensor, high: Tensor) -> Tensor:
    """Returns given positions as a tensor, float32 `shape`.

    Args:
        given: positions in cells, of this shape, or without the first dimension for all alike.
        shape: [num_envs, uavs, 3].
        low, high: [3], the corners of the box, cells.

    Raises:
        UserError: they have another shape, or lie outside of the box.
    """
    shapes = [*shape[1:]], [*shape]
    points = torch.as_tensor(given, dtype=torch.float32, device=low.device)
    if [*points.shape] not in shapes or not ((points >= low) & (points <= high)).all():
        raise UserError(
            f"position: shape {list(points.shape)}; expected {shapes[0]} or {shapes[1]} inside "
            f"the box {low.tolist()} to {high.tolist()}"
        )
    return points.expand(*shape)


def distance(first: Tensor, second: Tensor) -> Tensor:
    """Returns Euclidean distances, float64 [...], between points [..., 3]."""
    return torch.linalg.vector_norm(first.double() - second.double(), dim=-1)


def scale_to_box(position: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Scales positions in cells, float32 [..., 3], to [-1, 1] along each side of the box."""
    half = ((high - low) / 2).clamp(min=1e-6)
    return ((position - low) / half - 1).float()
