"""Models the cameras of UAVs: computes the cells in view, and their number and mean per class."""

import math

import torch
from torch import Tensor, nn

from emberlink.envs.config import WildfireConfig
from emberlink.envs.utils import counter_rng
from emberlink.envs.utils.counter_rng import Use
from emberlink.envs.world import motion


def view_radius(altitude: float, view_angle: float) -> float:
    """Returns half the side of the square in view, cells, from altitude (cells) and angle (°)."""
    return altitude * math.tan(math.radians(view_angle))


class Sensor(nn.Module):
    """A downward camera that sees cells (i, j) with |i - x| and |j - y| <= z tan(view_angle).

    Each UAV has a window of W x W cells, centred at the cell nearest to it, that contains the field
    of view at any altitude. Maps are stored flat and padded by half a window, so that windows lie
    within them. The cost of a step depends on the size of the window, not of the map.

    A cell in view is recognised with a probability that falls with altitude, independently at each
    look. That recognition gets worse with altitude is usual (Popovic et al. 2017, ICRA, let the
    variance of a measurement grow with it). The straight line, its values, and that a UAV knows
    which cells it has not recognised are assumptions of this project.

    Args:
        world: the world; its highest altitude determines the size of the window.
    """

    _offsets: Tensor
    _window: Tensor
    _weights: Tensor

    def __init__(self, world: WildfireConfig):
        super().__init__()
        lowest, highest = (x[2].item() for x in motion.corners(world.low, world.high))
        self._altitude, self._recognised, grid = (lowest, highest), world.sensor, world.grid
        reach = min(math.floor(view_radius(highest, world.view_angle) + 0.5), max(grid) - 1)
        self._inner = tuple(slice(reach, reach + side) for side in grid)
        self._padded = grid[0] + 2 * reach, grid[1] + 2 * reach
        self._slope = math.tan(math.radians(world.view_angle))
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

    def recognition(self, altitude: Tensor) -> Tensor:
        """Returns the probability that a cell in view is recognised, from altitudes, float64."""
        (lowest, highest), (near, far) = self._altitude, self._recognised
        return near + (far - near) * (altitude - lowest) / max(highest - lowest, 1e-6)

    def look(
        self,
        position: Tensor,
        start: Tensor,
        rng_key: Tensor | None = None,
        step: Tensor | None = None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Returns the window of each UAV and whether its cells are in view.

        Args:
            position: float64 [..., n, 3], within the grid, cells.
            start: int64, broadcast against [..., n]: index of the first cell of each UAV's map.
            rng_key, step: int64 [...], `keys.RNG_KEY` and the step since the episode began, which
                determine the recognised cells; None: all cells are recognised.

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
        if self._recognised != (1.0, 1.0) and rng_key is not None and step is not None:
            key = counter_rng.step_key(rng_key, step, Use.RECOGNITION)
            unit = counter_rng.uniform(key, in_view.shape[-2:].numel())
            in_view &= unit.view_as(in_view) < self.recognition(position[..., 2:])
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


def search_altitude(world: WildfireConfig) -> float:
    """Returns the altitude at which a UAV in flight recognises the most cells in a step.

    A cell of the strip in view is looked at as often as the UAV takes steps across its view. If
    every cell is recognised, it is the maximum altitude.
    """
    low, high = (x[2].item() for x in motion.corners(world.low, world.high))
    altitude = torch.linspace(low, high, 61, dtype=torch.float64)
    width = 2 * view_radius(1.0, world.view_angle) * altitude
    missed = (1 - Sensor(world).recognition(altitude)) ** (width / world.displacement)
    return altitude[(width * (1 - missed)).argmax()].item()
