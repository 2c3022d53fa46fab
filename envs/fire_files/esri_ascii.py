"""Rasters in ESRI ASCII, as FARSITE, FlamMap and ELMFIRE write them."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from emberlink.envs.utils.errors import UserError

from .arrival_raster import RasterSource, Units
from .detect import beside
from .gdal_open import opened
from .geotiff import clean, raster_source
from .projection import check_projection, library

MOST_CELLS = 25_000_000
"""of a file that is text"""
_KEYS = ("ncols", "nrows", "xllcorner", "xllcenter", "yllcorner", "yllcenter")
_KEYS += ("cellsize", "dx", "dy", "nodata_value")
_ALLOWED = b"0123456789+-.eEnaNAiIfF \t\r\n"


def read_ascii(path: Path, unit: Units | None, crs: str | None) -> RasterSource:
    """Arrival times from ESRI ASCII; a .prj beside it is its projection.

    The values are read here: GDAL takes what is no number for 0 and wraps rows of another length.

    Args:
        path: an .asc.
        unit: of its numbers.
        crs: `fire.crs`.

    Raises:
        ValueError: one line that names the line or value that is wrong.
    """
    with path.open("rb") as file:
        header, rows = _header(file)
        columns, count = (_whole(header, key) for key in ("ncols", "nrows"))
        if columns * count > MOST_CELLS:
            raise UserError(
                f"{columns} x {count} cells; an .asc may have {MOST_CELLS}; expected a GeoTIFF, as "
                "gdal_translate makes of it"
            )
        values = list(_rows(file, rows, columns, count, len(header) + 1))
    times = np.concatenate(values).reshape(count, columns)
    never = times == header["nodata_value"] if "nodata_value" in header else None
    at, own_crs = _affine(header, count), _crs(path)
    check_projection(path, own_crs)
    return raster_source(clean(times, never), at, own_crs, unit, crs)


def _header(file: Any) -> tuple[dict[str, float], bytes]:
    """The keys of the header, and the first line after it."""
    header: dict[str, float] = {}
    while line := file.readline(1_000_000_000):
        words = line.split()
        if not words:
            continue
        if not words[0][:1].isalpha() or words[0][:3].lower() in (b"nan", b"inf"):
            break
        key = words[0].decode("latin-1").lower()
        number = len(header) + 1
        if key not in _KEYS:
            raise UserError(
                f"line {number}: {key[:30]!r} is no key of ESRI ASCII; expected {', '.join(_KEYS)}"
            )
        try:
            value = float(words[1]) if len(words) == 2 and b"_" not in words[1] else None
        except ValueError:
            value = None
        if value is None or key in header:
            raise UserError(f"line {number}: expected {key} once, with one number")
        header[key] = value
    for needed in (("ncols",), ("nrows",), ("cellsize", "dx"), ("cellsize", "dy")):
        if not any(key in header for key in needed):
            raise UserError(f"the header has no {needed[0]}; expected ESRI ASCII")
    for needed in _KEYS[2:4], _KEYS[4:6]:
        if sum(key in header for key in needed) != 1:
            raise UserError(f"the header must have one of {' and '.join(needed)}")
    for key, value in header.items():
        if key in ("cellsize", "dx", "dy") and not 0 < value < math.inf:
            raise UserError(f"{key}={value:g}; expected a size above 0")
        if key[0] in "xy" and not math.isfinite(value):
            raise UserError(f"{key}={value:g}; expected a coordinate")
    return header, line


def _affine(header: dict[str, float], rows: int) -> tuple[float, ...]:
    dx, dy = (header.get(key, header.get("cellsize", 0.0)) for key in ("dx", "dy"))
    x = header.get("xllcorner", header.get("xllcenter", 0.0) - dx / 2)
    y = header.get("yllcorner", header.get("yllcenter", 0.0) - dy / 2)
    return dx, 0.0, x, 0.0, -dy, y + rows * dy


def _crs(path: Path) -> Any:
    """The projection in the .prj beside it, of which GDAL knows all kinds."""
    if beside(path, ".prj") is None:
        library("rasterio", f"{path.suffix} rasters")
        return None
    with opened(path, "AAIGrid") as dataset:
        return dataset.crs


def _whole(header: dict[str, float], key: str) -> int:
    value = header[key]
    if not 1 <= value < 1e12 or value != int(value):
        raise UserError(f"{key}={value:g}; expected a whole number above 0")
    return int(value)


def _rows(file: Any, line: bytes, columns: int, count: int, number: int) -> Iterator[np.ndarray]:
    """The rows, of which the first is in `line`."""
    rows = 0
    while line:
        if line.strip():
            if line.translate(None, _ALLOWED):
                strange = line.translate(None, _ALLOWED)[:20].decode("latin-1")
                raise UserError(f"line {number}: {strange!r}; expected numbers")
            words = line.split()
            if len(words) != columns:
                raise UserError(f"line {number}: {len(words)} numbers; expected ncols={columns}")
            if rows == count:
                raise UserError(f"line {number}: a row too many; expected nrows={count}")
            try:
                yield np.array(words, dtype=np.float64)
            except ValueError as error:
                raise UserError(f"line {number}: {error}; expected numbers") from None
            rows += 1
        line, number = file.readline(), number + 1
    if rows < count:
        raise UserError(f"{rows} rows; expected nrows={count}: the file is cut off")
