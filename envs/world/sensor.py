"""What UAVs see: the cells in view, and how many of each class and where they are."""

import math

import torch
from torch import Tensor

from emberlink.envs.utils.buffers import Buffers


def view_radius(altitude: float, view_angle: float) -> float:
    """Half the side of the square that is seen from `altitude` cells, in cells."""
    return altitude * math.tan(math.radians(view_angle))


class View(Buffers):
    """A camera that looks down: |i - x| <= z tan(angle) and |j - y| <= z tan(angle).

    Every UAV is given a window of V cells around the cell that is nearest to it. So that a window
    never sticks out, a map is kept with a margin as wide as the window reaches, and flat: what a
    look costs grows with the window and not with the map.

    Args:
        grid: cells along x and y.
        view_angle: half the opening angle, degrees.
        ceiling: the highest altitude, cells; it fixes the size of the window.
    """

    _offsets: Tensor
    _window: Tensor
    _moments: Tensor

    def __init__(self, grid: tuple[int, int], *, view_angle: float, ceiling: float):
        super().__init__()
        reach = min(math.floor(view_radius(ceiling, view_angle) + 0.5), max(grid) - 1)
        self._inner = tuple(slice(reach, reach + side) for side in grid)
        self._padded = grid[0] + 2 * reach, grid[1] + 2 * reach
        self._slope = math.tan(math.radians(view_angle))
        self.side = 2 * reach + 1
        """cells along a side of the window"""
        offsets = torch.arange(-reach, reach + 1)
        i, j = torch.meshgrid(offsets, offsets, indexing="ij")
        self.register_buffer("_offsets", offsets.double(), persistent=False)
        self.register_buffer(
            "_window", ((i + reach) * self._padded[1] + j + reach).flatten(), persistent=False
        )
        # In float64, so that the sums of a window of any size are whole numbers.
        moments = torch.stack((i, j, torch.ones_like(i)), -1).flatten(0, 1)
        self.register_buffer("_moments", moments.double(), persistent=False)

    @property
    def area(self) -> int:
        """Cells of a map with its margin."""
        return self._padded[0] * self._padded[1]

    def pad(self, maps: Tensor, margin: float) -> Tensor:
        """Maps [..., X, Y] with `margin` around them, flat: [..., area]."""
        padded = maps.new_full((*maps.shape[:-2], *self._padded), margin)
        padded[..., self._inner[0], self._inner[1]] = maps
        return padded.flatten(-2)

    def crop(self, flat: Tensor) -> Tensor:
        """The other way: [..., area] -> [..., X, Y]."""
        return flat.unflatten(-1, self._padded)[..., self._inner[0], self._inner[1]]

    def look(self, position: Tensor, start: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The window of every UAV.

        Args:
            position: float64 [..., n, 3] within the grid, cells. In float64, so that a scalar
                program that reads the same float32 positions finds the same cells.
            start: int64 that broadcasts against [..., n]: where each UAV's map begins.

        Returns:
            centre: float64 [..., n, 2], the (i, j) of the cell under the UAV.
            cells: int64 [..., n, V], the window in the flat maps.
            near: bool [..., n, V], which of it are in view, those in the margin too.
        """
        ground = position[..., :2]
        centre = ground.round()
        distance = ((centre - ground).unsqueeze(-1) + self._offsets).abs_()
        near = distance <= (position[..., 2:] * self._slope).unsqueeze(-1)
        columns, rows = near.unbind(-2)
        near = (columns.unsqueeze(-1) & rows.unsqueeze(-2)).flatten(-2)
        i, j = centre.unbind(-1)
        corner = torch.add(j, i, alpha=self._padded[1]).long() + start
        return centre, corner.unsqueeze(-1) + self._window, near

    def tally(self, classes: Tensor, centre: Tensor) -> tuple[Tensor, Tensor]:
        """How many cells each class has, and their mean.

        Args:
            classes: bool [..., k, V], which cells of a window belong to each of k classes.
            centre: float64 [..., 2], from `look`.

        Returns:
            Counts, float64 [..., k], and mean (i, j), float32 [..., k, 2], 0 where there is none.
        """
        sums = classes.double() @ self._moments
        offset, count = sums.split((2, 1), -1)
        total = torch.addcmul(offset, count, centre.unsqueeze(-2))
        return count.squeeze(-1), total.div_(count.clamp(min=1)).float()
