"""Motion of the UAVs: pure functions of tensors.

`move` works in float64 inside, so that a scalar program that reads the same float32 positions
finds the same exits.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from emberlink.envs.utils import counter_rng


def corners(low: Sequence[float], high: Sequence[float]) -> tuple[Tensor, Tensor]:
    """Returns two corners of the box, float64 [3] each, rounded to values that float32 has.

    Positions are stored as float32: a UAV at an altitude of 3.3 must not be outside of a box that
    begins at 3.3.
    """
    both = torch.tensor([low, high], dtype=torch.float32).double()
    return both[0], both[1]


def move(
    position: Tensor, action: Tensor, *, displacement: float, low: Tensor, high: Tensor
) -> tuple[Tensor, Tensor]:
    """Moves all UAVs at once and clips their positions to the box.

    Args:
        position: [..., 3], cells; numbers that float32 has exactly.
        action: float32 [..., 3]; components outside [-1, 1] are clipped to it, and NaN counts
            as 0.
        displacement: cells per unit of action.
        low, high: float64 [3], the corners of the box, cells; numbers that float32 has exactly.

    Returns:
        The new positions, float32 [..., 3], and the axes along which the move would have left
        the box, bool [..., 3].
    """
    clipped = action.nan_to_num(0.0).clamp_(-1, 1)
    wanted = torch.add(position.double(), clipped, alpha=displacement)
    inside = wanted.clamp(low, high)
    return inside.float(), inside != wanted


def random_points(key: Tensor, count: int, low: Tensor, high: Tensor) -> Tensor:
    """Draws uniform points of the box, float32 [..., count, 3], one set for each key of [...]."""
    unit = counter_rng.uniform(key, count * 3).unflatten(-1, (count, 3))
    points = low.float() + unit * (high - low).float()
    return torch.minimum(points, high.float())  # rounding may exceed the box


def next_waypoint(
    waypoint: Tensor, position: Tensor, key: Tensor, low: Tensor, high: Tensor
) -> Tensor:
    """Returns the waypoint, or another random point of the box if the UAV is closer than 1 to it.

    Args:
        waypoint, position: float32 [..., n, 3], cells.
        key: int64 [...], used for nothing else at this step.
        low, high: [3], the corners of the box, cells.
    """
    reached = (distance(position, waypoint) < 1).unsqueeze(-1)
    return torch.where(reached, random_points(key, position.shape[-2], low, high), waypoint)


def distance(first: Tensor, second: Tensor) -> Tensor:
    """Returns Euclidean distances, float64 [...], between points [..., 3]."""
    return torch.linalg.vector_norm(first.double() - second.double(), dim=-1)


def scale_to_box(position: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Scales positions in cells, float32 [..., 3], to [-1, 1] along each side of the box."""
    half = ((high - low) / 2).clamp(min=1e-6)
    return ((position - low) / half - 1).float()
