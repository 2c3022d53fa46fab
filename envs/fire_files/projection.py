"""What the readers share: the optional libraries, kept quiet, and the projection of coordinates."""

import importlib
import logging
import math
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from emberlink.envs.utils.errors import UserError

from .detect import beside

Move = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""from x and y to x and y"""
Bounds = tuple[float, float, float, float]
"""least x, least y, greatest x, greatest y"""

_LOGGERS = ("rasterio", "pyogrio", "fiona", "shapely", "pyproj")
_DEGREE_CELL = 0.1  # a cell as large as this is 11 km wide if its side is in degrees
_DEGREE_EXTENT = 5.0  # a fire as large as this is 500 km wide if it is in degrees
_WIDEST = 20.0  # degrees
_FARTHEST = 1e9  # metres; no projection of the Earth has such coordinates


def library(name: str, what: str) -> Any:
    """A module of the extra `geo`.

    Raises:
        ValueError: it is not installed; `what` says for what it is needed.
    """
    try:
        return importlib.import_module(name)
    except ImportError:
        raise UserError(
            f"reading {what} needs the extra geo: pip install 'emberlink[geo]' ({name} is missing)"
        ) from None


@contextmanager
def quiet() -> Iterator[None]:
    """Keeps to itself what the libraries warn of: what matters of it becomes an error here."""
    loggers = [logging.getLogger(name) for name in _LOGGERS]
    before = [logger.disabled for logger in loggers]
    levels = [logger.level for logger in loggers]
    try:
        for logger in loggers:
            logger.disabled = True
            logger.setLevel(logging.CRITICAL + 1)
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            yield
    finally:
        for logger, disabled, level in zip(loggers, before, levels, strict=True):
            logger.disabled = disabled
            logger.setLevel(level)


def first_line(error: BaseException) -> str:
    """What a library says is wrong, short."""
    if error.__cause__ and "previous exception" in str(error):
        error = error.__cause__
    lines = str(error).strip().splitlines() or [type(error).__name__]
    return lines[0][:200]


def one_line(text: str) -> str:
    """A message without line breaks and control characters, which a file may bring into it."""
    return "".join(c if c.isprintable() else " " for c in text)


def same(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The coordinates as they are."""
    return x, y


def to_plane(crs: Any, wanted: str | None, bounds: Bounds, cell: float | None) -> tuple[Move, Move]:
    """How coordinates of a file become coordinates on a plane, and back.

    Args:
        crs: the file's own projection, None if it carries none.
        wanted: `fire.crs`: the projection of a file that carries none, else the one to project to.
        bounds: of the file's coordinates.
        cell: side of a raster's cells in these coordinates; None for perimeters.

    Raises:
        ValueError: degrees without a projection, an unknown projection, or coordinates outside it.
    """
    if not all(map(math.isfinite, bounds)) or max(map(abs, bounds)) > _FARTHEST:
        raise UserError(f"coordinates from {bounds[:2]} to {bounds[2:]} are not on the Earth")
    if crs is None and wanted is None:
        _refuse_degrees(bounds, cell)
        return same, same
    source = _crs(crs) if crs is not None else _crs(wanted)
    if crs is not None and wanted is None and not source.is_geographic:
        return same, same
    if source.is_geographic and not _in_degrees(bounds):
        raise UserError(
            f"coordinates from {bounds[:2]} to {bounds[2:]} are not degrees, which "
            f"{source.name} is in; expected longitude and latitude, or another fire.crs"
        )
    if crs is not None and wanted is not None:
        target = _crs(wanted)
        if target.is_geographic:
            raise UserError(f"fire.crs={wanted} is in degrees; expected one in metres, as UTM is")
    elif source.is_geographic:
        target = _utm(bounds)
    else:
        return same, same
    return _moves(source, target, bounds)


def _moves(source: Any, target: Any, bounds: Bounds) -> tuple[Move, Move]:
    transformer = library("pyproj", "a projection").Transformer
    there = transformer.from_crs(source, target, always_xy=True).transform
    inverse = transformer.from_crs(target, source, always_xy=True).transform
    middle = (bounds[0] + bounds[2]) / 2

    def back(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x, y = inverse(x, y)
        if source.is_geographic:  # a file that goes beyond 180 degrees has longitudes that do
            x = x - 360 * np.rint((x - middle) / 360)
        return x, y

    corners = there(np.array(bounds[0::2]), np.array(bounds[1::2]))
    if not np.isfinite(corners).all() or np.abs(corners).max() > _FARTHEST:
        raise UserError(
            f"coordinates from {bounds[:2]} to {bounds[2:]} cannot be projected from "
            f"{source.name} to {target.name}; expected another fire.crs"
        )
    return there, back


def _crs(value: Any) -> Any:
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


def check_projection(path: Path, crs: Any) -> None:
    """That a .prj beside a file, if there is one, was understood.

    Args:
        path: the file.
        crs: what was found; None for nothing.

    Raises:
        ValueError: it was not.
    """
    prj = beside(path, ".prj")
    if crs is None and prj is not None and prj.stat().st_size:
        raise UserError(
            f"{prj.name}, beside it, holds no projection that is known; expected one, or no such "
            "file and fire.crs, such as fire.crs=EPSG:32611"
        )


def _utm(bounds: Bounds) -> Any:
    """The UTM zone around the middle."""
    width, height = bounds[2] - bounds[0], bounds[3] - bounds[1]
    if max(width, height) > _WIDEST:
        raise UserError(
            f"{width:g} x {height:g} degrees: a UTM zone is no plane for them; expected fire.crs, "
            "a projection in metres, or a file of the fire alone"
        )
    pyproj = library("pyproj", "degrees")
    x, y = (bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2
    x = (x + 180) % 360 - 180
    area = importlib.import_module("pyproj.aoi").AreaOfInterest(x, y, x, y)
    found = importlib.import_module("pyproj.database").query_utm_crs_info("WGS 84", area)
    if not found:
        raise UserError(
            f"there is no UTM zone at longitude {x:g}, latitude {y:g}; expected fire.crs, a "
            "projection in metres"
        )
    return pyproj.CRS.from_epsg(found[0].code)
