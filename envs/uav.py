"""Motion and field of view of the UAVs: pure functions of tensors.

Both work in float64 inside, so that a scalar program that reads the same float32 positions finds
the same cells and the same exits, to the last one.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from . import streams


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
        position: float32 [..., 3], cells.
        action: float32 [..., 3]; components outside [-1, 1] are clipped to it, and one that is
            not a number does not move the UAV.
        displacement: cells per unit of action.
        low, high: float64 [3], the corners of the box, cells; numbers that float32 has exactly.

    Returns:
        The new positions, float32 [..., 3], and the axes along which the move would have left
        the box, bool [..., 3].
    """
    step = displacement * action.double().nan_to_num(0.0).clamp(-1, 1)
    wanted = position.double() + step
    beyond = (wanted < low) | (wanted > high)
    return wanted.clamp(low, high).to(position.dtype), beyond


def view_radius(altitude: float, view_angle: float) -> float:
    """Half the side of the square that is seen from `altitude` cells, in cells."""
    return altitude * math.tan(math.radians(view_angle))


def view(
    position: Tensor, *, view_angle: float, ceiling: float, grid: tuple[int, int]
) -> tuple[Tensor, Tensor, Tensor]:
    """The cells in view: |i - x| <= z tan(angle) and |j - y| <= z tan(angle).

    Args:
        position: float32 [..., 3], cells.
        view_angle: half the opening angle, degrees.
        ceiling: the highest altitude, cells; it fixes the size of the window.
        grid: cells along x and y.

    Returns:
        cells: int64 [..., V, 2], the (i, j) of a window of V cells around each UAV, moved into
            the grid where it would stick out.
        flat: int64 [..., V], i * Y + j of those.
        visible: bool [..., V], which of them are in view; each cell of the grid is at most once.
    """
    reach = min(math.floor(view_radius(ceiling, view_angle) + 0.5), max(grid) - 1)
    offsets = torch.arange(-reach, reach + 1, device=position.device)
    size = torch.tensor(grid, device=position.device).unsqueeze(-1)
    ground = position[..., :2].double().unsqueeze(-1)
    index = ground.round().long() + offsets
    radius = position[..., 2:, None].double() * math.tan(math.radians(view_angle))
    inside = ((index - ground).abs() <= radius) & (index >= 0) & (index < size)
    index = torch.minimum(index.clamp(min=0), size - 1)
    i, j = torch.broadcast_tensors(index[..., 0, :, None], index[..., 1, None, :])
    cells = torch.stack((i, j), -1).flatten(-3, -2)
    visible = (inside[..., 0, :, None] & inside[..., 1, None, :]).flatten(-2)
    return cells, cells[..., 0] * grid[1] + cells[..., 1], visible


def random_points(stream: Tensor, count: int, low: Tensor, high: Tensor) -> Tensor:
    """Uniform points of the box, float32 [..., count, 3], one set for each stream of [...]."""
    unit = streams.uniform(stream, count * 3).unflatten(-1, (count, 3))
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


def mean_cell(cells: Tensor, chosen: Tensor) -> Tensor:
    """Mean (i, j) of the chosen cells, float32 [..., 2], 0 where there is none.

    Args:
        cells: int64 [..., V, 2].
        chosen: bool [..., V].
    """
    total = (cells * chosen.unsqueeze(-1)).sum(-2).double()
    return (total / chosen.sum(-1, keepdim=True).clamp(min=1)).float()
