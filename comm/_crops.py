"""Draws what UAVs know as pictures around them, at several scales."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

CHANNELS = ("fire", "seen", "burnt_out", "near", "age", "outside", "uavs", "base")
"""names of a picture's channels, see `Crops`"""
_FULL = 255
_OLD = 1000.0  # steps; the age of the darkest known cells
_SPREAD = 50.0  # steps; time scale at which the chance of ignition near known fire grows
# Bits of an int64 at which the sum over a pixel begins: counts of 10 bits, sums of bytes of 16.
_FIRE, _SEEN, _BURNT_OUT, _NEAR, _AGE, _END = 0, 10, 20, 30, 46, 62


def age_byte(age: int) -> int:
    """Returns the brightness of an age in steps: 0 for none, 254 from 1000 steps on."""
    return min(_FULL - 1, round((_FULL - 1) * math.log1p(age) / math.log1p(_OLD)))


def chance_byte(age: int) -> int:
    """Returns the chance that a cell without fire near a fire burns, `age` steps after a look."""
    return round(_FULL * (1 - math.exp(-age / _SPREAD)))


class Crops(nn.Module):
    """Draws pictures of S x S pixels; the cell nearest to the UAV is in pixel (S // 2, S // 2).

    The channels hold bytes. `fire`, `seen` and `burnt_out` are the shares of the pixel's cells that
    burned at the last look, that were seen while they burned, and that had burnt out at the last
    look. `near` is the mean chance that a cell burns by now. Only cells at most `spread` cells away
    from known fire have one: `chance_byte` of the steps since the last look for cells without fire
    then, 255 for cells never seen. `age` is the mean of `age_byte` over the cells of the grid, 255
    for a cell that was never seen. `outside` is the share of cells outside of the grid. `uavs`
    shows other UAVs as they are known, 255 less `age_byte`, and `base` the base station, 255.

    The sums over pixels come from one summed-area table of all channels, whose sums are fields of
    an int64; they are exact.

    Args:
        grid: cells along x and y.
        pixels: S.
        scales: cells along the side of a pixel in each picture, at most `LARGEST_SCALE`.
        spread: cells.
        horizon: steps of an episode.
    """

    _fields: Tensor
    _ages: Tensor
    _edges: Tensor

    def __init__(
        self,
        grid: tuple[int, int],
        *,
        pixels: int,
        scales: Sequence[int],
        spread: int,
        horizon: int,
    ):
        super().__init__()
        self.grid, self.pixels, self.scales, self.spread = grid, pixels, tuple(scales), spread
        fields = []
        ages = range(min(horizon, int(_OLD)) + 2)  # older looks have the bytes of the last age
        for age in ages:
            old, chance = age_byte(age) << _AGE, chance_byte(age) << _NEAR
            never = _FULL << _AGE, _FULL << _NEAR
            burns, burnt_out = (old + (1 << kind) for kind in (_FIRE, _BURNT_OUT))
            for known, may in (never, (burnt_out, 0), (burns, 0), (old, chance)):
                fields += [known + seen + near for seen in (0, 1 << _SEEN) for near in (0, may)]
        self.register_buffer("_fields", torch.tensor(fields), persistent=False)
        self.register_buffer("_ages", torch.tensor([*map(age_byte, ages)]), persistent=False)
        edges = [
            [(pixel - pixels // 2) * scale - scale // 2 for pixel in range(pixels + 1)]
            for scale in scales
        ]
        self.register_buffer("_edges", torch.tensor(edges), persistent=False)

    @property
    def rows(self) -> int:
        """The number of maps to draw at a time, whose sums fit into a cache."""
        return max(1, 2**17 // math.prod(self.grid))

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """The shape of pictures: scales, channels, and pixels along both sides."""
        return len(self.scales), len(CHANNELS), self.pixels, self.pixels

    def draw(
        self,
        known: Tensor,
        seen: Tensor,
        step: Tensor,
        centre: Tensor,
        uavs: Tensor,
        heard: Tensor,
        base: Tensor,
    ) -> Tensor:
        """Returns the pictures, uint8 [rows, *shape].

        Args:
            known: integers [rows, X, Y], 4 times the step of the last look plus the cell's state
                then (0 no fire, 1 fire, 2 burnt out), -1 for never.
            seen: bool [rows, X, Y], whether a cell was seen while it burned.
            step: int64 [rows], steps since the episode began.
            centre: int64 [rows, 2], the cell nearest to the UAV.
            uavs: int64 [rows, k, 2], the cells of other UAVs.
            heard: int64 [rows, k], the step at which they are known, -1 for never.
            base: int64 [rows, 0 or 1, 2], the cell of the base.
        """
        table = self._summed(known, seen, step)
        age = self._ages.take((step.unsqueeze(-1) - heard).clamp(0, len(self._ages) - 1))
        bright = torch.where(heard >= 0, _FULL - age, 0)
        pictures = []
        for edges, scale in zip(self._edges, self.scales, strict=True):
            channels = self._sums(table, centre, edges, scale)
            at = centre.unsqueeze(1), edges, scale
            channels.append(self._marks(uavs, bright, *at))
            channels.append(self._marks(base, torch.full_like(base[..., 0], _FULL), *at))
            pictures.append(torch.stack(channels, 1))
        return torch.stack(pictures, 1)

    def _summed(self, known: Tensor, seen: Tensor, step: Tensor) -> Tensor:
        """Returns the sums of all fields over the cells below and left, int64 [rows, X+1, Y+1]."""
        age = (4 * step + 3).to(torch.int32).view(-1, 1, 1) - known
        most = len(self._fields) // 4 - 4
        if int(step.max()) >= most // 4:  # looks may be older than the table; they keep their kind
            age = age.minimum((age & 3) + most)
        kind = age.mul_(4).add_(seen, alpha=2)
        if self.spread:
            kind += _widened(known & 3 == 1, self.spread)
        fields = self._fields.index_select(0, kind.flatten()).view_as(kind)
        # The sums overflow; their differences, which fit into the fields, are exact all the same.
        return torch.nn.functional.pad(fields, (1, 0, 1, 0)).cumsum_(2).cumsum_(1)

    def _sums(self, table: Tensor, centre: Tensor, edges: Tensor, scale: int) -> list[Tensor]:
        """Returns the channels that are sums over pixels, int64 [rows, S, S] each."""
        x, y = (
            (centre[:, axis : axis + 1] + edges).clamp(0, side)
            for axis, side in enumerate(self.grid)
        )
        row = torch.arange(len(table), device=table.device).view(-1, 1, 1)
        place = (row * table.shape[1] + x.unsqueeze(-1)) * table.shape[2] + y.unsqueeze(1)
        sums = table.take(place).diff(dim=1).diff(dim=2)
        inside = x.diff(dim=1).unsqueeze(-1) * y.diff(dim=1).unsqueeze(1)

        def field(first: int, end: int) -> Tensor:
            return (sums >> first) & ((1 << (end - first)) - 1)

        cells = scale * scale
        shares = [
            _rounded(_FULL * field(first, first + 10), cells)
            for first in (_FIRE, _SEEN, _BURNT_OUT)
        ]
        near = _rounded(field(_NEAR, _AGE), cells)
        age = _rounded(field(_AGE, _END), inside.clamp(min=1))
        return [*shares, near, age, _rounded(_FULL * (cells - inside), cells)]

    def _marks(
        self, cell: Tensor, value: Tensor, centre: Tensor, edges: Tensor, scale: int
    ) -> Tensor:
        """Returns a channel with the largest value of the points in each pixel, [rows, S, S]."""
        pixel = torch.div(cell - centre - edges[0], scale, rounding_mode="floor")
        shown = ((pixel >= 0) & (pixel < self.pixels)).all(-1)
        x, y = pixel.clamp(0, self.pixels - 1).unbind(-1)
        plane = value.new_zeros(len(cell), self.pixels * self.pixels)
        plane.scatter_reduce_(1, x * self.pixels + y, value * shown, "amax")
        return plane.unflatten(1, (self.pixels, self.pixels)).to(torch.uint8)


def _rounded(total: Tensor, count: Tensor | int) -> Tensor:
    """Returns total / count, rounded half up; float32 is exact enough for sums of a pixel."""
    # By way of 16 bits, which takes a quarter of the time on a CPU.
    return (total / count).add_(0.5).to(torch.int16).to(torch.uint8)


def _widened(mask: Tensor, reach: int) -> Tensor:
    """Returns whether a cell of a mask, bool [rows, X, Y], is within `reach` along x and y."""
    for axis in (1, 2):
        wide, side = mask.clone(), mask.shape[axis]
        for by in range(1, min(reach, side - 1) + 1):
            wide.narrow(axis, by, side - by).logical_or_(mask.narrow(axis, 0, side - by))
            wide.narrow(axis, 0, side - by).logical_or_(mask.narrow(axis, by, side - by))
        mask = wide
    return mask
