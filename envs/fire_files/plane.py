"""Chooses the plane on which a fire is gridded, and the window of it that the grid covers."""

import math
from typing import Any, NamedTuple

import numpy as np

from emberlink.envs.fire_files.files import damage
from emberlink.envs.fire_files.report import ask

Bounds = tuple[float, float, float, float]
"""Minimum x, minimum y, maximum x, maximum y."""
DEGREES = "EPSG:4326"
_BENT = 1.1  # ratio of a projection's axes above which a file is projected to another plane
_MAX_DEGREES = 20.0  # across; a UTM zone is no plane for more
_SAMPLES = 180  # points along the grid's shorter side; a cell gets the earliest of them
_EDGE = 1e-6  # cells: tolerance, so that rounding does not move a centre across an edge


class Plane(NamedTuple):
    """How a file's coordinates become coordinates on a plane: `target` is None if they are."""

    about: str
    source: Any = None
    target: Any = None
    unit: float = 1.0  # metres on the ground of a unit of length on the plane, where it is known
    west: float = -180.0  # the lowest longitude of the file's degrees

    def project(self, x: Any, y: Any, *, back: bool = False) -> tuple[Any, Any]:
        """Projects coordinates of the file onto the plane, or back."""
        if self.target is None:
            return x, y
        from pyproj import Transformer

        ends = (self.target, self.source) if back else (self.source, self.target)
        x, y = Transformer.from_crs(*ends, always_xy=True).transform(x, y)
        if back and self.source.is_geographic:  # longitudes as the file has them
            x = (x - self.west) % 360 + self.west
        return x, y


class Window(NamedTuple):
    """A part of the plane that a grid (X, Y) covers with square cells, from a lower left corner."""

    x: float
    y: float
    side: float
    grid: tuple[int, int]

    @classmethod
    def around(cls, bounds: Bounds, grid: tuple[int, int], margin: float) -> "Window":
        """Returns the smallest window with a margin, a part of the grid, around `bounds`."""
        width, height = bounds[2] - bounds[0], bounds[3] - bounds[1]
        side = max(width / grid[0], height / grid[1]) / (1 - 2 * margin)
        x, y = (bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2
        return cls(x - side * grid[0] / 2, y - side * grid[1] / 2, side, grid)

    def samples(self) -> "Window":
        """Returns the window of the sample points, the centres of its cells."""
        (columns, rows), cuts = self.grid, max(1, round(_SAMPLES / min(self.grid)))
        return Window(self.x, self.y, self.side / cuts, (columns * cuts, rows * cuts))

    def earliest(self, samples: np.ndarray) -> np.ndarray:
        """Returns the earliest sample in each cell, [X, Y]."""
        cuts = len(samples) // self.grid[0]
        return samples.reshape(self.grid[0], cuts, self.grid[1], cuts).min((1, 3))

    def centres(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns x and y of the cells' centres, [X, Y] each."""
        columns, rows = np.indices(self.grid) + 0.5
        return self.x + columns * self.side, self.y + rows * self.side

    def cells(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns the indices of the cells in which points lie, and which are in the grid."""
        shares = (x - self.x) / self.side, (y - self.y) / self.side
        i, j = (np.floor(share + _EDGE).astype(np.int64) for share in shares)
        return i, j, (i >= 0) & (j >= 0) & (i < self.grid[0]) & (j < self.grid[1])


@damage("another fire.crs, such as EPSG:32611")
def choose_plane(crs: Any, wanted: str | None, bounds: Bounds) -> Plane:
    """Chooses the plane for the coordinates of a file; a projection that bends is replaced.

    `wanted` is `fire.crs`: the projection of a file without one, otherwise the target.
    """
    from geopandas import GeoSeries
    from pyproj import CRS
    from shapely import box

    size = max(bounds[2] - bounds[0], bounds[3] - bounds[1])
    where = f"coordinates from {bounds[:2]} to {bounds[2:]}"
    in_degrees = max(map(abs, bounds[::2])) <= 360 and max(map(abs, bounds[1::2])) <= 90.01
    if crs is None and wanted is None:
        if in_degrees and size < 5:
            seen = f"{where} may be degrees, and no projection is given"
            raise ask(seen, "fire.crs, such as fire.crs=EPSG:4326 for longitude and latitude")
        return Plane("no projection in the file: its coordinates are taken as a plane")
    source = CRS.from_user_input(crs or wanted)
    if source.is_geographic and not (in_degrees and size <= _MAX_DEGREES):
        seen = f"{where} are not the degrees of {source.name}, or too far apart for one UTM zone"
        raise ask(seen, "another fire.crs", "a file of the fire alone")
    shape, ratio, unit = _shape(source, source, bounds)
    if not (crs and wanted) and ratio <= _BENT:
        return Plane(f"projection {source.name} ({shape})", source, unit=unit)
    middle = (bounds[0] + bounds[2]) / 2
    turn = 360 * round(middle / 360) if source.is_geographic else 0  # for longitudes to 360
    zone: Any = GeoSeries([box(*bounds)], crs=source).translate(-turn).estimate_utm_crs
    target = CRS.from_user_input(wanted) if crs and wanted else zone()
    after, bent, unit = _shape(target, source, bounds)
    if bent > _BENT:
        raise ask(f"fire.crs={wanted} has {after} here", "one as UTM is")
    about = f"projection {source.name} ({shape}), projected to {target.name} ({after})"
    return Plane(about, source, target, unit, middle - 180)


def _shape(crs: Any, source: Any, bounds: Bounds) -> tuple[str, float, float]:
    """Returns how a small circle at the fire is bent, as text, the ratio of its axes, the unit."""
    from pyproj import Proj, Transformer

    unit = crs.axis_info[0].unit_conversion_factor if crs.axis_info else 1.0
    if not crs.is_projected:  # coordinates are degrees, or of no projection
        return ("degrees", math.inf, 1.0) if crs.is_geographic else ("a plane", 1.0, unit)
    at = (bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2
    to_degrees = Transformer.from_crs(source, source.geodetic_crs, always_xy=True)
    factors = Proj(crs).get_factors(*to_degrees.transform(*at), errcheck=True)
    ratio = float(factors.tissot_semimajor / factors.tissot_semiminor)
    turn = round(factors.meridian_convergence)
    about = f"axes {ratio:.2f} : 1, north turned by {turn} degrees"
    return about, ratio, unit / factors.tissot_semimajor
