"""Imports the libraries of the extra `geo`, and chooses and applies projections onto a plane."""

import importlib
import logging
import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from emberlink.envs.fire_files.formats import beside
from emberlink.envs.fire_files.sidecars import read_sidecar
from emberlink.envs.utils.errors import UserError, how_to_install

Bounds = tuple[float, float, float, float]
"""Minimum x, minimum y, maximum x, maximum y."""

Affine = tuple[float, float, float, float, float, float]
"""(a, b, c, d, e, f): the outer corners of cells are at x = a column + b row + c and
y = d column + e row + f."""

_LOGGERS = ("rasterio", "pyogrio", "fiona", "shapely", "pyproj")
_DEGREE_CELL = 0.1  # a cell as large as this is 11 km wide if its side is in degrees
_DEGREE_EXTENT = 5.0  # a fire as large as this is 500 km wide if it is in degrees
_MAX_DEGREES = 20.0  # across; a UTM zone is no plane for more
_MAX_METRES = 1e9  # no projection of the Earth has such coordinates


def library(name: str, what: str = "reading this file") -> Any:
    """Imports a module of the extra `geo`.

    Raises:
        UserError: the module is not installed; `what` needs it.
    """
    try:
        return importlib.import_module(name)
    except ImportError:
        raise UserError(
            f"{what} needs the extra geo: {how_to_install('geo')} ({name} is missing)"
        ) from None


@contextmanager
def quiet() -> Iterator[None]:
    """Silences the warnings and logs of the libraries. Damage is reported as an error instead."""
    loggers = [logging.getLogger(name) for name in _LOGGERS]
    levels = [logger.level for logger in loggers]
    try:
        for logger in loggers:
            logger.setLevel(logging.CRITICAL + 1)
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


def first_line(error: BaseException) -> str:
    """Returns the first line of a library's message, at most 200 characters of it."""
    if error.__cause__ and "previous exception" in str(error):
        error = error.__cause__
    lines = str(error).strip().splitlines() or [type(error).__name__]
    return lines[0][:200]


def projections(
    crs: Any, wanted: str | None, bounds: Bounds, cell: float | None
) -> tuple[Any, Any] | None:
    """Chooses how coordinates of a file are projected onto a plane.

    Args:
        crs: the projection of the file; None if it has none.
        wanted: `fire.crs`: the projection of a file without one, otherwise the target.
        bounds: bounds of the coordinates.
        cell: side of a raster's cells in these coordinates; None for perimeters.

    Returns:
        The source and the target projection, pyproj.CRS; None if the coordinates are on a plane
        already. Degrees are projected to the UTM zone of the middle.

    Raises:
        UserError: degrees without a projection, an unknown projection, or coordinates outside it.
    """
    if not all(map(math.isfinite, bounds)) or max(map(abs, bounds)) > _MAX_METRES:
        raise UserError(f"coordinates from {bounds[:2]} to {bounds[2:]} are not on the Earth")
    if crs is None and wanted is None:
        _refuse_degrees(bounds, cell)
        return None
    source = _parse_crs(crs or wanted)
    if crs and wanted and not (source.is_projected or source.is_geographic):
        crs, source = None, _parse_crs(wanted)  # a plane of its own: the user knows which it is
    if source.is_geographic and not _in_degrees(bounds):
        raise UserError(
            f"coordinates from {bounds[:2]} to {bounds[2:]} are not degrees, which "
            f"{source.name} is in; expected longitude and latitude, or another fire.crs"
        )
    if source.is_geographic and not -180 <= bounds[0] <= bounds[2] <= 180:
        raise UserError(
            f"longitudes from {bounds[0]:g} to {bounds[2]:g}; expected -180 to 180, or a file in "
            "metres for a fire across 180 degrees"
        )
    if crs and wanted:
        target = _parse_crs(wanted)
        if not target.is_projected:
            what = "in degrees" if target.is_geographic else "not one of a map"
            raise UserError(f"fire.crs={wanted} is {what}; expected one in metres, as UTM is")
        return source, target
    return (source, _utm(bounds)) if source.is_geographic else None


def check_projection(path: Path, crs: Any) -> None:
    """Checks that the projection in a .prj beside a file was read.

    Raises:
        UserError: the file has a .prj, and `crs` is None.
    """
    prj = beside(path, ".prj")
    if crs is None and prj is not None and prj.stat().st_size:
        raise UserError(
            f"{prj.name}, beside it, holds no projection that is known; expected one, or no such "
            "file and fire.crs, such as fire.crs=EPSG:32611"
        )


def _parse_crs(value: Any) -> Any:
    pyproj = library("pyproj", "a projection")
    try:
        return pyproj.CRS.from_user_input(value)
    except pyproj.exceptions.CRSError:
        raise UserError(
            f"the projection {str(value)[:100]!r} is not known; expected such as EPSG:32611"
        ) from None


def _in_degrees(bounds: Bounds) -> bool:
    return bounds[0] >= -360 and bounds[2] <= 360 and bounds[1] >= -90.01 and bounds[3] <= 90.01


def _refuse_degrees(bounds: Bounds, cell: float | None) -> None:
    small = max(bounds[2] - bounds[0], bounds[3] - bounds[1]) < _DEGREE_EXTENT
    if _in_degrees(bounds) and (small if cell is None else cell < _DEGREE_CELL):
        raise UserError(
            f"coordinates from {bounds[:2]} to {bounds[2:]} look like degrees, and no projection "
            "is given; expected fire.crs, such as fire.crs=EPSG:4326 for longitude and latitude"
        )


def _utm(bounds: Bounds) -> Any:
    """Returns the UTM zone of the middle of `bounds`."""
    width, height = bounds[2] - bounds[0], bounds[3] - bounds[1]
    x, y = (bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2
    if max(width, height) > _MAX_DEGREES or abs(y) > 84:
        raise UserError(
            f"{width:g} x {height:g} degrees around latitude {y:g}: no UTM zone is a plane for "
            "them; expected fire.crs, a projection in metres, or a file of the fire alone"
        )
    zone = min(int((x + 180) // 6), 59) + 1
    return _parse_crs(f"EPSG:{(32600 if y >= 0 else 32700) + zone}")


def read_prj(path: Path) -> Any:
    """Returns the projection in the .prj beside a file, None if there is none."""
    prj = beside(path, ".prj")
    if prj is None:
        return None
    pyproj = library("pyproj", "a projection")
    try:
        return pyproj.CRS.from_user_input(read_sidecar(prj))
    except UserError:
        raise
    except (pyproj.exceptions.CRSError, ValueError):
        return check_projection(path, None)


def warped(
    times: np.ndarray, affine: Affine, chosen: tuple[Any, Any] | None, max_cells: int
) -> tuple[np.ndarray, Affine]:
    """Projects times and rotates the raster north up, on cells of half the size.

    Times are interpolated between burnt cells. A point in a cell that never burns stays inf.

    Raises:
        UserError: the result would have more than `max_cells` cells.
    """
    rasterio = library("rasterio")
    vrt = library("rasterio.vrt").WarpedVRT
    source, target = chosen or ("EPSG:3857", "EPSG:3857")  # any plane: only rotated
    about = {
        "height": times.shape[0],
        "width": times.shape[1],
        "transform": rasterio.Affine(*affine),
    }
    with rasterio.MemoryFile() as memory:
        with memory.open(
            "GTiff", count=1, dtype="float64", crs=source, nodata=math.nan, **about
        ) as dataset:
            dataset.write(np.where(np.isfinite(times), times, np.nan), 1)
        with memory.open() as dataset:
            with vrt(dataset, crs=target) as view:
                size = {"width": 2 * view.width, "height": 2 * view.height}
                if math.prod(size.values()) > max_cells:
                    raise UserError(
                        f"{size['width']} x {size['height']} cells after its projection to a "
                        f"plane; at most {max_cells} are read; expected a part of the file, or "
                        "one in metres"
                    )
                transform = view.transform @ rasterio.Affine.scale(0.5)
            sampled = []
            for method in ("nearest", "bilinear"):
                resampling = rasterio.enums.Resampling[method]
                with vrt(
                    dataset, crs=target, transform=transform, resampling=resampling, **size
                ) as view:
                    sampled.append(view.read(1))
    inside, between = (np.where(np.isnan(values), np.inf, values) for values in sampled)
    return np.where(np.isinf(inside) | np.isinf(between), inside, between), transform[:6]
