"""Reads rasters of arrival times: ESRI ASCII (FARSITE, FlamMap, ELMFIRE) and GeoTIFF."""

import logging
import logging.handlers
import math
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from emberlink.envs.fire_files.config import Clock, Units
from emberlink.envs.fire_files.plausibility import begins_at_zero, doubts_of_names, doubts_of_values
from emberlink.envs.fire_files.projection import (
    Affine,
    first_line,
    library,
    projections,
    read_prj,
    warped,
)
from emberlink.envs.fire_files.raster_source import RasterSource, check_spreads
from emberlink.envs.utils.errors import UserError

MAX_CELLS = 50_000_000
"""Cells of a raster, which is read as a whole."""
MAX_TIME = 1e12
"""Maximum time; a larger number is not a time."""
_NEVER = (-9999.0, -1.0)  # NODATA of FARSITE and FlamMap, and of ELMFIRE
_VOID = 1e30  # a number beyond it is NODATA although not declared, such as -3.4e38
_COUNT, _SIZE, _PLACE = "a whole number above 0", "a size above 0", "a coordinate"
_KEYS = {"ncols": _COUNT, "nrows": _COUNT, "cellsize": _SIZE, "dx": _SIZE, "dy": _SIZE}
_KEYS |= dict.fromkeys(("xllcorner", "xllcenter", "yllcorner", "yllcenter"), _PLACE)
_KEYS |= {"nodata_value": "a number"}
_NEEDED = (("ncols",), ("nrows",), ("cellsize", "dx"), ("cellsize", "dy"))
_NEEDED += (("xllcorner", "xllcenter"), ("yllcorner", "yllcenter"))
_DAMAGE = re.compile(r"IO error|tag ignored|TIFFVSetField|(Null|Incorrect) count|_tiff\w+Proc:")


def read_geotiff(path: Path, unit: Units | None, crs: str | None) -> RasterSource:
    """Reads arrival times from a GeoTIFF with one band.

    `unit` is the unit of the times; if it is None, the tag units=steps tells it.

    Raises:
        UserError: the file is damaged, is not a raster of times, or has no geotransform.
    """
    with open_raster(path) as dataset:
        _check_band(dataset)
        declared = "all_valid" not in [flag.name for flag in dataset.mask_flag_enums[0]]
        never = dataset.read_masks(1) == 0 if declared else None
        times = clean(dataset.read(1), never) * dataset.scales[0] + dataset.offsets[0]
        tagged: Units | None = "steps" if dataset.tags().get("units") == "steps" else None
        affine, source_crs = dataset.transform[:6], dataset.crs
        name, measure = (dataset.descriptions[0] or "")[:60], (dataset.units[0] or "")[:20]
        doubts = list(doubts_of_names([*_texts(dataset), path.stem], measure))
    name = f"{name!r} ({measure})" if measure else repr(name) if name else ""
    return _on_plane(times, affine, source_crs, unit or tagged, crs, name, doubts)


def read_ascii(path: Path, unit: Units | None, crs: str | None) -> RasterSource:
    """Reads arrival times from ESRI ASCII, with the projection in a .prj beside the file.

    NumPy reads the numbers, because GDAL reads a word as 0 and wraps rows of another length.

    Raises:
        UserError: a line of the header or a number is wrong.
    """
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        header, lines = _read_header(file)
        shape = int(header["nrows"]), int(header["ncols"])
        if math.prod(shape) > MAX_CELLS:
            raise UserError(f"{shape[1]} x {shape[0]} cells; at most {MAX_CELLS} are read")
        try:
            values = np.loadtxt(file, comments=None, ndmin=2, max_rows=math.prod(shape) + 1)
        except ValueError as error:
            raise UserError(
                f"after {lines} lines of header: {first_line(error).split(';')[0]}; expected "
                f"rows of {shape[1]} numbers"
            ) from None
    if values.shape != shape:
        raise UserError(
            f"{values.shape[0]} rows of {values.shape[1]} numbers; expected nrows={shape[0]} rows "
            f"of ncols={shape[1]}"
        )
    dx, dy = (header.get(key, header.get("cellsize", 0.0)) for key in ("dx", "dy"))
    x = header.get("xllcorner", header.get("xllcenter", 0.0) - dx / 2)
    y = header.get("yllcorner", header.get("yllcenter", 0.0) - dy / 2)
    never = values == header["nodata_value"] if "nodata_value" in header else None
    affine = dx, 0.0, x, 0.0, -dy, y + shape[0] * dy
    doubts = list(doubts_of_names([path.stem]))
    return _on_plane(clean(values, never), affine, read_prj(path), unit, crs, doubts=doubts)


def _texts(dataset: Any) -> list[str]:
    """Returns the texts in a GeoTIFF that name its values."""
    tags = {**dataset.tags(), **dataset.tags(1)}
    named = [tags[key] for key in ("TIFFTAG_IMAGEDESCRIPTION", "long_name") if key in tags]
    return [text for text in (dataset.descriptions[0], *named) if text]


@contextmanager
def open_raster(path: Path) -> Iterator[Any]:
    """Opens a GeoTIFF with rasterio.

    Raises:
        UserError: the file is damaged, also if GDAL only logs the damage.
    """
    rasterio = library("rasterio")
    log = logging.handlers.BufferingHandler(capacity=1_000_000)
    logger = logging.getLogger("rasterio._env")
    level, propagate = logger.level, logger.propagate
    logger.setLevel(logging.WARNING)
    logger.propagate = False
    logger.addHandler(log)
    try:
        with rasterio.open(path, driver="GTiff") as dataset:
            yield dataset
    except (rasterio.errors.RasterioError, OSError) as error:
        raise UserError(f"{first_line(error)}; expected a whole raster") from None
    finally:
        logger.removeHandler(log)
        logger.setLevel(level)
        logger.propagate = propagate
    for record in log.buffer:
        message = record.getMessage()
        if record.levelno >= logging.ERROR or _DAMAGE.search(message):
            raise UserError(f"damaged: {message[:200]}; expected a whole raster")


def clean(times: np.ndarray, never: np.ndarray | None = None) -> np.ndarray:
    """Returns arrival times in which cells that never burn are inf, float32 or float64.

    Args:
        times: values of a file, any real type.
        never: mask of the NODATA that the file declares. Without one, the maximum of an integer
            type is NODATA, and the minimum of a signed one.

    Raises:
        UserError: a number is not a time.
    """
    if never is None and times.dtype.kind in "iu":
        limits = np.iinfo(times.dtype)
        never = (times == limits.max) | ((times == limits.min) & (limits.min < 0))
    times = np.array(times, dtype=np.result_type(times, np.float32))
    if never is not None:
        times[never] = np.inf
    odd = ~(times >= 0) | ((times > MAX_TIME) & (times < np.inf))
    values = times[odd]
    wrong = ~(np.isnan(values) | (np.abs(values) > _VOID) | np.isin(values, _NEVER))
    if wrong.any():
        raise UserError(
            f"{values[wrong][0]:g} is not an arrival time; expected 0 or more, or NODATA (-9999, "
            "-1, NaN or what the file declares)"
        )
    times[odd] = np.inf
    return times


def _check_band(dataset: Any) -> None:
    if dataset.count != 1:
        raise UserError(
            f"{dataset.count} bands; expected one, or a bank of fires, tagged units=steps"
        )
    kind = np.dtype(dataset.dtypes[0])
    if kind.kind not in "iuf":
        raise UserError(f"values of type {kind}; expected real numbers")
    if kind.itemsize == 1 and dataset.nodata is None:
        raise UserError(f"values of type {kind} without NODATA, as of a picture; expected times")
    if dataset.width * dataset.height > MAX_CELLS:
        raise UserError(
            f"{dataset.width} x {dataset.height} cells; at most {MAX_CELLS} are read; expected a "
            "part, such as gdalwarp -te cuts out"
        )
    check_blocks(dataset)
    if dataset.transform.is_identity:
        raise UserError(
            "no geotransform, so that the place of the cells is not known; expected one, such as "
            "gdal_translate -a_ullr writes"
        )


def check_blocks(dataset: Any) -> None:
    """Checks the size of the blocks of a GeoTIFF, which may be larger than the raster.

    Raises:
        UserError: a block is too large to read.
    """
    rows, columns = dataset.block_shapes[0]
    if rows * columns > MAX_CELLS:
        raise UserError(f"blocks of {columns} x {rows} cells; at most {MAX_CELLS} are read")


def _read_header(file: TextIO) -> tuple[dict[str, float], int]:
    """Reads the header of ESRI ASCII up to the first row.

    Returns:
        The values, and the number of lines.
    """
    header: dict[str, float] = {}
    while True:
        start = file.tell()
        words = file.readline(1000).split()
        key = words[0].lower() if words else ""
        if not key[:1].isalpha() or key[:3] in ("nan", "inf"):
            file.seek(start)
            break
        line = len(header) + 1
        if key not in _KEYS:
            raise UserError(
                f"line {line}: {key[:30]!r} is not a key of ESRI ASCII; expected {', '.join(_KEYS)}"
            )
        if key in header or len(words) != 2 or not _is_valid(key, words[1]):
            text = " ".join(words)[:60]
            raise UserError(f"line {line}: {text!r}; expected {key} once, with {_KEYS[key]}")
        header[key] = float(words[1])
    for keys in _NEEDED:
        if sum(key in header for key in keys) != 1:
            raise UserError(f"expected one {' or '.join(keys)} in the header of ESRI ASCII")
    return header, len(header)


def _is_valid(key: str, text: str) -> bool:
    """Tells whether the value of a key of ESRI ASCII is one."""
    try:
        value = float(text)
    except ValueError:
        return False
    if _KEYS[key] is _COUNT:
        return 1 <= value < 1e12 and value % 1 == 0
    if _KEYS[key] is _SIZE:
        return 0 < value < math.inf
    return math.isfinite(value) if _KEYS[key] is _PLACE else True


def _on_plane(
    times: np.ndarray,
    affine: Affine,
    source_crs: Any,
    unit: Units | None,
    crs: str | None,
    name: str = "",
    doubts: Sequence[str] = (),
) -> RasterSource:
    """Returns cleaned times on a plane, north up.

    Raises:
        UserError: no fire spreads, there is no unit, or the coordinates are not valid.
    """
    check_spreads(times)
    a, b, c, d, e, f = (float(value) for value in affine)
    area = abs(a * e - b * d)
    if not math.isfinite(c + f) or not 1e-20 < area < 1e12:
        raise UserError(f"cells of {a:g} x {e:g}; expected a size above 0")
    if unit is None:
        raise UserError(
            "the unit of the raster's times is not known; expected fire.units=minutes (FARSITE, "
            "FlamMap), seconds (ELMFIRE), hours, days or steps"
        )
    doubts = [*doubts, *doubts_of_values(times, unit)]
    rows, columns = times.shape
    corners = [(a * u + b * v + c, d * u + e * v + f) for u in (0, columns) for v in (0, rows)]
    x, y = zip(*corners, strict=True)
    chosen = projections(source_crs or None, crs, (min(x), min(y), max(x), max(y)), math.sqrt(area))
    clock, from_zero = Clock(unit), begins_at_zero(times)  # by the cells of the file
    if a < 0 and not (b or d):
        times, a, c = times[:, ::-1], -a, c + columns * a
    if e > 0 and not (b or d):
        times, e, f = times[::-1], -e, f + rows * e
    if chosen or b or d:
        times, affine = warped(times, (a, b, c, d, e, f), chosen, MAX_CELLS)
        a, b, c, d, e, f = affine
        check_spreads(times)
    about = {"name": name, "doubts": doubts, "from_zero": from_zero}
    return RasterSource(times, (c, f), (a, -e), clock, **about)
