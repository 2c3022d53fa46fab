"""Models the cameras of UAVs: computes the cells in view, and their number and mean per class."""

import math

import torch
from torch import Tensor, nn

from emberlink.envs.config import WildfireConfig
from emberlink.envs.world import motion


def view_radius(altitude: float, view_angle: float) -> float:
    """Returns half the side of the square in view, cells, from altitude (cells) and angle (°)."""
    return altitude * math.tan(math.radians(view_angle))


class Sensor(nn.Module):
    """A downward camera that sees cells (i, j) with |i - x| and |j - y| <= z tan(view_angle).

    Each UAV has a window of W x W cells, centred at the cell nearest to it, that contains the field
    of view at any altitude. Maps are stored flat and padded by half a window, so that windows lie
    within them. The cost of a step depends on the size of the window, not of the map.

    Args:
        grid: cells along x and y.
        view_angle: half the opening angle, degrees.
        ceiling: the maximum altitude, cells; it determines the size of the window.
    """

    _offsets: Tensor
    _window: Tensor
    _weights: Tensor

    def __init__(self, grid: tuple[int, int], *, view_angle: float, ceiling: float):
        super().__init__()
        reach = min(math.floor(view_radius(ceiling, view_angle) + 0.5), max(grid) - 1)
        self._inner = tuple(slice(reach, reach + side) for side in grid)
        self._padded = grid[0] + 2 * reach, grid[1] + 2 * reach
        self._slope = math.tan(math.radians(view_angle))
        self.side = 2 * reach + 1
        """W, cells along a side of the window"""
        offsets = torch.arange(-reach, reach + 1)
        i, j = torch.meshgrid(offsets, offsets, indexing="ij")
        self.register_buffer("_offsets", offsets.double(), persistent=False)
        self.register_buffer(
            "_window", ((i + reach) * self._padded[1] + j + reach).flatten(), persistent=False
        )
        weights = torch.stack((i, j, torch.ones_like(i)), -1).flatten(0, 1)
        # Sums over a window are exact: they are whole numbers, of at most 24 bits in float32.
        exact = torch.float32 if reach * self.side**2 < 2**24 else torch.float64
        self.register_buffer("_weights", weights.to(exact), persistent=False)

    @classmethod
    def of(cls, world: WildfireConfig) -> "Sensor":
        """Returns the sensor of the UAVs of a world."""
        ceiling = motion.corners(world.low, world.high)[1][2].item()
        return cls(world.grid, view_angle=world.view_angle, ceiling=ceiling)

    @property
    def area(self) -> int:
        """The number of cells of a padded map."""
        return self._padded[0] * self._padded[1]

    def pad(self, maps: Tensor, value: float) -> Tensor:
        """Pads maps [..., X, Y] with a value and flattens them: [..., area]."""
        padded = maps.new_full((*maps.shape[:-2], *self._padded), value)
        padded[..., self._inner[0], self._inner[1]] = maps
        return padded.flatten(-2)

    def crop(self, flat: Tensor) -> Tensor:
        """Reverses `pad`: [..., area] -> [..., X, Y]."""
        return flat.unflatten(-1, self._padded)[..., self._inner[0], self._inner[1]]

    def look(self, position: Tensor, start: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Returns the window of each UAV and whether its cells are in view.

        Args:
            position: float64 [..., n, 3], within the grid, cells.
            start: int64, broadcast against [..., n]: index of the first cell of each UAV's map.

        Returns:
            centre: float64 [..., n, 2], the (i, j) of the cell nearest to the UAV.
            cells: int64 [..., n, W * W], the indices of the window's cells in the flat maps.
            in_view: bool [..., n, W * W]; cells of the padding can be in view.
        """
        ground = position[..., :2]
        centre = ground.round()
        distance = ((centre - ground).unsqueeze(-1) + self._offsets).abs_()
        near = distance <= (position[..., 2:] * self._slope).unsqueeze(-1)
        columns, rows = near.unbind(-2)
        in_view = (columns.unsqueeze(-1) & rows.unsqueeze(-2)).flatten(-2)
        i, j = centre.unbind(-1)
        corner = torch.add(j, i, alpha=self._padded[1]).long() + start
        return centre, corner.unsqueeze(-1) + self._window, in_view

    def count_classes(self, classes: Tensor, centre: Tensor) -> tuple[Tensor, Tensor]:
        """Computes the number of cells of each class and their mean.

        Args:
            classes: bool [..., k, W * W], masks of the cells of k classes.
            centre: float64 [..., 2], from `look`.

        Returns:
            Number, float64 [..., k], and mean (i, j), float32 [..., k, 2]; 0 without any cell.
        """
        sums = (classes.to(self._weights.dtype) @ self._weights).double()
        offset, count = sums.split((2, 1), -1)
        total = torch.addcmul(offset, count, centre.unsqueeze(-2))
        return count.squeeze(-1), total.div_(count.clamp(min=1)).float()
