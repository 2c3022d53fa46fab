"""Motion of the UAVs: pure functions of tensors.

`move` works in float64 inside, so that a scalar program that reads the same float32 positions
finds the same exits, to the last one.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from emberlink.envs.utils import counter_rng


def corners(low: Sequence[float], high: Sequence[float]) -> tuple[Tensor, Tensor]:
    """Two corners of the box, float64 [3] each, at the values that float32 has for them.

    Positions are stored as float32: who stands at an altitude of 3.3 is not beyond it.
    """
    both = torch.tensor([low, high], dtype=torch.float32).double()
    return both[0], both[1]


def move(
    position: Tensor, action: Tensor, *, displacement: float, low: Tensor, high: Tensor
) -> tuple[Tensor, Tensor]:
    """All UAVs move at once and are clipped to the box.

    Args:
        position: [..., 3], cells; numbers that float32 has exactly.
        action: float32 [..., 3]; components outside [-1, 1] are clipped to it, and one that is
            not a number does not move the UAV.
        displacement: cells per unit of action.
        low, high: float64 [3], the corners of the box, cells; numbers that float32 has exactly.

    Returns:
        The new positions, float32 [..., 3], and the axes along which the move would have left
        the box, bool [..., 3].
    """
    pushed = action.nan_to_num(0.0).clamp_(-1, 1)
    wanted = torch.add(position.double(), pushed, alpha=displacement)
    inside = wanted.clamp(low, high)
    return inside.float(), inside != wanted


def random_points(stream: Tensor, count: int, low: Tensor, high: Tensor) -> Tensor:
    """Uniform points of the box, float32 [..., count, 3], one set for each stream of [...]."""
    unit = counter_rng.uniform(stream, count * 3).unflatten(-1, (count, 3))
    points = low.float() + unit * (high - low).float()
    return torch.minimum(points, high.float())  # rounding may step over the edge


def next_waypoint(
    waypoint: Tensor, position: Tensor, stream: Tensor, low: Tensor, high: Tensor
) -> Tensor:
    """The waypoint, or another random point of the box once the UAV is closer than 1 to it.

    Args:
        waypoint, position: float32 [..., n, 3], cells.
        stream: int64 [...], one that is used for nothing else this step.
        low, high: [3], the corners of the box, cells.
    """
    reached = (distance(position, waypoint) < 1).unsqueeze(-1)
    return torch.where(reached, random_points(stream, position.shape[-2], low, high), waypoint)


def distance(one: Tensor, other: Tensor) -> Tensor:
    """Euclidean distance, float64 [...] from points [..., 3]."""
    return torch.linalg.vector_norm(one.double() - other.double(), dim=-1)


def scale_to_box(position: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Positions in cells, float32 [..., 3], to [-1, 1] along each side of the box."""
    half = ((high - low) / 2).clamp(min=1e-6)
    return ((position - low) / half - 1).float()
