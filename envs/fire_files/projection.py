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
    width, height = bounds[2] - bounds[0], bounds[3] - bounds[1]
    span = f"coordinates from {bounds[:2]} to {bounds[2:]}"
    if not all(map(math.isfinite, bounds)) or max(map(abs, bounds)) > _MAX_METRES:
        raise UserError(f"{span} are not on the Earth")
    in_degrees = max(map(abs, bounds[::2])) <= 360 and max(map(abs, bounds[1::2])) <= 90.01
    if crs is None and wanted is None:
        # Cells of 0.1 degrees would be 11 km wide, a fire of 5 degrees 500 km.
        if in_degrees and (max(width, height) < 5 if cell is None else cell < 0.1):
            raise UserError(
                f"{span} may be degrees, and no projection is given; expected fire.crs, such as "
                "fire.crs=EPSG:4326 for longitude and latitude"
            )
        return Plane("no projection in the file: its coordinates are taken as a plane")
    source = parse_crs(crs or wanted)
    if crs and wanted and not (source.is_projected or source.is_geographic):
        crs, source = None, parse_crs(wanted)  # a local plane that the user knows
    degrees = source.is_geographic
    if degrees and not (in_degrees and abs(bounds[0] + bounds[2]) <= 360):
        raise UserError(f"{span} are not the degrees of {source.name}; expected another fire.crs")
    if not (source.is_projected or degrees):
        return Plane(f"{source.name}, taken as a plane", None, _metres(source))
    at = _middle(source, bounds)
    ratio, turn = (math.inf, 0.0) if degrees else _distortion(source, at)
    if crs and wanted:
        target = parse_crs(wanted)
        bent = _distortion(target, at)[0] if target.is_projected else math.inf
        if bent > _BENT:
            why = f"has axes {bent:.2f} : 1 here" if target.is_projected else "is in degrees"
            raise UserError(f"fire.crs={wanted} {why}; expected one as UTM is")
    elif ratio <= _BENT:
        return Plane(f"projection {source.name} ({_shape(ratio, turn)})", None, _metres(source))
    elif (degrees and max(width, height) > _MAX_DEGREES) or abs(at[1]) > 84:
        raise UserError(
            f"{span}: no UTM zone is a plane for them; expected fire.crs in metres, or a "
            "file of the fire alone"
        )
    else:
        zone = min(int((at[0] + 180) // 6), 59) + 1
        target = parse_crs(f"EPSG:{(32600 if at[1] >= 0 else 32700) + zone}")
    bent = "degrees" if degrees else _shape(ratio, turn)
    after = f"projected to {target.name} ({_shape(*_distortion(target, at))})"
    return Plane(f"projection {source.name} ({bent}), {after}", (source, target), _metres(target))


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


def _shape(ratio: float, turn: float) -> str:
    return f"axes {ratio:.2f} : 1, north turned by {turn:.0f} degrees"


def _middle(crs: Any, bounds: Bounds) -> tuple[float, float]:
    """Returns longitude and latitude of the middle of bounds."""
    at = (bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2
    if not crs.is_geographic:
        change = library("pyproj").Transformer.from_crs(crs, crs.geodetic_crs, always_xy=True)
        at = change.transform(*at)
    if not math.isfinite(sum(at)):
        raise UserError(f"coordinates from {bounds[:2]} to {bounds[2:]} lie outside {crs.name}")
    return at


def _distortion(crs: Any, at: tuple[float, float]) -> tuple[float, float]:
    """Returns the ratio of the axes of a small circle's image, and by how much north is turned."""
    change = library("pyproj").Transformer.from_crs(crs.geodetic_crs, crs, always_xy=True)
    latitude = math.radians(at[1])
    east, north = 1e-4 / max(math.cos(latitude), 1e-9), 1e-4
    x, y = np.array(at)[:, None] + [[-east, east, 0, 0], [0, 0, -north, north]]
    x, y = (np.array(part) for part in change.transform(x, y))
    jacobian = np.array([[x[1] - x[0], x[3] - x[2]], [y[1] - y[0], y[3] - y[2]]])
    jacobian[:, 0] *= 0.99331 / (1 - 0.00669 * math.sin(latitude) ** 2)  # of the ellipsoid
    if not np.isfinite(jacobian).all() or not np.linalg.det(jacobian):
        raise UserError(f"the fire at {at} lies outside {crs.name}; expected another fire.crs")
    long, short = np.linalg.svd(jacobian, compute_uv=False)
    return float(long / short), math.degrees(math.atan2(jacobian[0, 1], jacobian[1, 1]))


def warped(
    times: np.ndarray, affine: Affine, change: tuple[Any, Any] | None
) -> tuple[np.ndarray, Affine]:
    """Projects times and rotates the raster north up, on cells of half the size.

    Times are interpolated between burnt cells. A point in a cell that never burns stays inf.
    """
    rasterio, vrt = library("rasterio"), library("rasterio.vrt").WarpedVRT
    source, target = change or ("EPSG:3857", "EPSG:3857")  # any plane: only rotated
    about: dict[str, Any] = {"driver": "GTiff", "count": 1, "dtype": "float64", "crs": source}
    about |= {"nodata": math.nan, "transform": rasterio.Affine(*affine)}
    about |= dict(zip(("height", "width"), times.shape, strict=True))
    with rasterio.MemoryFile() as memory:
        with memory.open(**about) as dataset:
            dataset.write(np.where(np.isfinite(times), times, np.nan), 1)
        with memory.open() as dataset:
            with vrt(dataset, crs=target) as view:
                size = {"width": 2 * view.width, "height": 2 * view.height}
                transform = view.transform @ rasterio.Affine.scale(0.5)
            if math.prod(size.values()) > MAX_CELLS:
                raise UserError(f"{size} cells on a plane; at most {MAX_CELLS}: expected a part")
            size |= {"crs": target, "transform": transform}
            sampled = []
            for method in ("nearest", "bilinear"):
                with vrt(dataset, resampling=rasterio.enums.Resampling[method], **size) as view:
                    sampled.append(view.read(1))
    inside, between = (np.where(np.isnan(values), np.inf, values) for values in sampled)
    return np.where(np.isinf(inside) | np.isinf(between), inside, between), transform[:6]
