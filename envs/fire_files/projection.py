"""Chooses the plane on which a fire is gridded, and measures how its projection bends shapes."""

import math
from typing import Any, NamedTuple

import numpy as np

from emberlink.envs.fire_files.files import library
from emberlink.envs.fire_files.grid import Bounds
from emberlink.envs.utils.errors import UserError

Affine = tuple[float, ...]
"""(a, b, c, d, e, f): the corners of cells are at x = a column + b row + c, y = d column + ..."""
MAX_CELLS = 50_000_000
"""Cells of a raster, which is read as a whole."""
_BENT = 1.1
"""Ratio of a projection's axes above which a file is projected to another plane."""
_MAX_DEGREES = 20.0  # across; a UTM zone is no plane for more
_MAX_METRES = 1e9  # no projection of the Earth has such coordinates


class Plane(NamedTuple):
    """The transformation of a file's coordinates to a plane, and notes for the user."""

    about: str
    change: tuple[Any, Any] | None = None
    """source and target projection, pyproj.CRS; None if the coordinates are on a plane already"""
    unit: float | None = None
    """metres of a unit of length on the plane, if known"""


def choose_plane(crs: Any, wanted: str | None, bounds: Bounds, cell: float | None) -> Plane:
    """Chooses the plane for the coordinates of a file.

    Degrees, and a projection whose axes differ by more than `_BENT` at the fire, are projected to
    the UTM zone of the middle.

    Args:
        crs: the projection of the file; None if it has none.
        wanted: `fire.crs`: the projection of a file without one, otherwise the target.
        cell: side of a raster's cells in these coordinates; None for perimeters.
    """
    size = max(bounds[2] - bounds[0], bounds[3] - bounds[1])
    where = f"coordinates from {bounds[:2]} to {bounds[2:]}"
    if not all(map(math.isfinite, bounds)) or max(map(abs, bounds)) > _MAX_METRES:
        raise UserError(f"{where} are not on the Earth")
    in_degrees = max(map(abs, bounds[::2])) <= 360 and max(map(abs, bounds[1::2])) <= 90.01
    if crs is None and wanted is None:
        # Cells of 0.1 degrees would be 11 km wide, a fire of 5 degrees 500 km.
        if in_degrees and (size < 5 if cell is None else cell < 0.1):
            raise UserError(
                f"{where} may be degrees, and no projection is given; expected fire.crs, such as "
                "fire.crs=EPSG:4326 for longitude and latitude"
            )
        return Plane("no projection in the file: its coordinates are taken as a plane")
    source = parse_crs(crs or wanted)
    if crs and wanted and not (source.is_projected or source.is_geographic):
        crs, source = None, parse_crs(wanted)  # a local plane that the user knows
    degrees = source.is_geographic
    if degrees and not (in_degrees and size <= _MAX_DEGREES):
        raise UserError(
            f"{where} are not the degrees of {source.name}, or no UTM zone is a plane for them; "
            "expected another fire.crs, or a file of the fire alone"
        )
    if not (source.is_projected or degrees):
        return Plane(f"{source.name}, taken as a plane", None, _metres(source))
    shape, ratio = _shape(source, source, bounds)
    if crs and wanted:
        target = parse_crs(wanted)
    elif ratio <= _BENT:
        return Plane(f"projection {source.name} ({shape})", None, _metres(source))
    else:
        box = library("shapely").box(*bounds)
        try:
            target = library("geopandas").GeoSeries([box], crs=source).estimate_utm_crs()
        except (RuntimeError, ValueError):
            raise UserError(
                f"{where}: no UTM zone is there; expected fire.crs, in metres"
            ) from None
    after, bent = _shape(target, source, bounds)
    if bent > _BENT:
        raise UserError(f"fire.crs={wanted} has {after} here; expected one as UTM is")
    about = f"projection {source.name} ({shape}), projected to {target.name} ({after})"
    return Plane(about, (source, target), _metres(target))


def parse_crs(value: Any) -> Any:
    """Returns a projection, pyproj.CRS."""
    pyproj = library("pyproj", "a projection")
    try:
        return pyproj.CRS.from_user_input(value)
    except pyproj.exceptions.CRSError:
        text = str(value)[:100]
        raise UserError(f"projection {text!r} is not known; expected such as EPSG:32611") from None


def _metres(crs: Any) -> float | None:
    return crs.axis_info[0].unit_conversion_factor if crs.axis_info else None


def _shape(crs: Any, source: Any, bounds: Bounds) -> tuple[str, float]:
    """Returns how a projection bends a small circle at the fire, as text, and the ratio of axes."""
    if crs.is_geographic:
        return "degrees", math.inf
    pyproj = library("pyproj")
    at = (bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2
    to_degrees = pyproj.Transformer.from_crs(source, source.geodetic_crs, always_xy=True)
    longitude, latitude = to_degrees.transform(*at)
    try:
        factors = pyproj.Proj(crs).get_factors(longitude, latitude, errcheck=True)
    except pyproj.exceptions.ProjError:
        raise UserError(
            f"the fire at {at} lies outside {crs.name}; expected another fire.crs"
        ) from None
    ratio = factors.tissot_semimajor / factors.tissot_semiminor
    turn = factors.meridian_convergence
    return f"axes {ratio:.2f} : 1, north turned by {round(turn)} degrees", float(ratio)


def warped(
    times: np.ndarray, affine: Affine, change: tuple[Any, Any] | None
) -> tuple[np.ndarray, Affine]:
    """Projects times and rotates the raster north up, on cells of half the size.

    Times are interpolated between burnt cells. A point in a cell that never burns stays inf.
    """
    warp, affines = library("rasterio.warp"), library("rasterio").Affine
    source, target = change or ("EPSG:3857", "EPSG:3857")  # any plane: only rotated
    rows, columns = times.shape
    corners = [affines(*affine) * at for at in ((0, 0), (columns, 0), (0, rows), (columns, rows))]
    x, y = zip(*corners, strict=True)
    box = min(x), min(y), max(x), max(y)
    to, width, height = warp.calculate_default_transform(source, target, columns, rows, *box)
    if 4 * width * height > MAX_CELLS:
        raise UserError(f"{2 * width} x {2 * height} cells on a plane; at most {MAX_CELLS}")
    to @= affines.scale(0.5)
    sampled = []
    for method in ("nearest", "bilinear"):
        place = np.full((2 * height, 2 * width), np.nan)
        warp.reproject(
            np.where(np.isfinite(times), times, np.nan),
            place,
            **{"src_transform": affines(*affine), "src_crs": source, "src_nodata": np.nan},
            **{"dst_transform": to, "dst_crs": target, "dst_nodata": np.nan},
            resampling=library("rasterio").enums.Resampling[method],
        )
        sampled.append(np.where(np.isnan(place), np.inf, place))
    inside, between = sampled
    return np.where(np.isinf(inside) | np.isinf(between), inside, between), to[:6]
