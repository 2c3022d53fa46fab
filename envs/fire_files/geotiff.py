"""Rasters of arrival times: what is common to them, and GeoTIFF."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from emberlink.envs.utils.errors import UserError

from .arrival_raster import Clock, RasterSource, Units
from .gdal_open import opened
from .projection import Bounds, library, to_plane

MOST_CELLS = 500_000_000
"""of a GeoTIFF, which is read strip by strip"""
KEPT_SIDE = 2048
"""cells along a side beyond which several are taken together, their earliest arrival kept"""
LATEST = 1e12
"""beyond it a number is no time"""
NEVER = (-9999.0, -1.0)
"""NODATA of FARSITE and FlamMap, and of ELMFIRE"""
_VOID = 1e30  # beyond it a number is NODATA that nobody declared, such as -3.4e38
_STRIP = 2_000_000  # cells read at a time
_MOST_BYTES = 200_000_000  # of a row of blocks, which GDAL decodes as a whole
_Part = tuple[int, int, int, int]  # first row and column, and how many


def read_geotiff(path: Path, unit: Units | None, crs: str | None) -> RasterSource:
    """Arrival times from a GeoTIFF of one band; the tag `units` of ours stands for `unit`.

    Raises:
        ValueError: one line that names what is wrong.
    """
    with opened(path) as dataset:
        _check_band(dataset)
        if dataset.transform.is_identity:
            raise UserError(
                "no geotransform: it does not say where its cells are, or has lost it; expected "
                "one, as gdal_translate -a_ullr gives it"
            )
        whole = 0, 0, dataset.height, dataset.width
        parts = [_read(dataset, whole)]
        burnt = _burnt(parts[0][0], whole)
        if _factor(burnt) < _factor(whole):  # a small fire in a large raster
            parts.append(_read(dataset, burnt))
        tags, source_crs = dataset.tags(), dataset.crs
    unit = unit or ("steps" if tags.get("units") == "steps" else None)
    sources = [raster_source(times, at, source_crs, unit, crs) for times, at in parts]
    sources[-1].extent = sources[0].extent
    return sources[-1]


def clean(times: np.ndarray, never: np.ndarray | None = None) -> np.ndarray:
    """Arrival times in which what never burns is inf, float32 or float64.

    Args:
        times: as a file has them, any real type.
        never: where the file itself says so; if it does not, the greatest number of an integer
            type is no time, and the least of one with a sign.

    Raises:
        ValueError: a number is no time.
    """
    if never is None and times.dtype.kind in "iu":
        most = np.iinfo(times.dtype)
        never = (times == most.max) | (times == (most.min if most.min < 0 else most.max))
    times = np.array(times, dtype=np.result_type(times, np.float32))
    if never is not None:
        np.copyto(times, np.inf, where=never)
    odd = ~(times >= 0) | ((times > LATEST) & (times < np.inf))
    values = times[odd]
    wrong = ~(np.isnan(values) | (np.abs(values) > _VOID) | np.isin(values, NEVER))
    if wrong.any():
        raise UserError(
            f"{values[wrong][0]:g} is no time of arrival; expected 0 or more, or NODATA (-9999, "
            "-1, NaN or what the file declares)"
        )
    np.copyto(times, np.inf, where=odd)
    return times


def check_spreads(times: np.ndarray, *, may_stand: bool = False) -> None:
    """That the arrival times are those of a fire that spreads.

    Args:
        times: with inf for never.
        may_stand: whether a part of the map may burn at once and nothing after it, as a fire does
            that was made for a few steps.

    Raises:
        ValueError: no cell burns, only one does, or all at once.
    """
    burning = times[np.isfinite(times)]
    if len(burning) == 0:
        raise UserError("no cell burns: NODATA everywhere; expected times of arrival")
    if len(burning) == 1:
        raise UserError("a single cell burns; expected a fire that spreads")
    if burning.min() == burning.max() and not (may_stand and len(burning) < times.size):
        raise UserError(
            f"all {len(burning)} cells burn at once, at {burning[0]:g}; "
            "expected a fire that spreads"
        )


def raster_source(
    times: np.ndarray, transform: Any, source_crs: Any, unit: Units | None, crs: str | None
) -> RasterSource:
    """A raster with its place and time.

    Raises:
        ValueError: no fire spreads, there is no unit, or its place is none.
    """
    check_spreads(times)
    affine = tuple(float(value) for value in transform[:6])
    area = abs(affine[0] * affine[4] - affine[1] * affine[3])
    if not all(map(math.isfinite, affine)) or not 1e-20 < area < 1e12:
        raise UserError(f"cells of {affine[0]:g} x {affine[4]:g}; expected a size above 0")
    if unit is None:
        raise UserError(
            "a raster does not say in what its times are: expected fire.units=minutes (FARSITE, "
            "FlamMap), seconds (ELMFIRE), hours, days or steps"
        )
    bounds = _corners(affine, times.shape)
    moves = to_plane(source_crs or None, crs, bounds, math.sqrt(area))
    return RasterSource(times, affine, Clock(unit), moves)


def _corners(affine: tuple[float, ...], shape: tuple[int, ...]) -> Bounds:
    a, b, c, d, e, f = affine
    corners = [(u, v) for u in (0, shape[1]) for v in (0, shape[0])]
    x, y = [a * u + b * v + c for u, v in corners], [d * u + e * v + f for u, v in corners]
    return min(x), min(y), max(x), max(y)


def _check_band(dataset: Any) -> None:
    if dataset.count != 1:
        raise UserError(
            f"{dataset.count} bands; expected one, or a bank of fires, tagged units=steps"
        )
    kind = np.dtype(dataset.dtypes[0])
    if kind.kind not in "iuf":
        raise UserError(f"values of type {dataset.dtypes[0]}; expected real numbers")
    if kind.itemsize == 1 and dataset.nodata is None:
        raise UserError(
            f"values of type {dataset.dtypes[0]} without NODATA, as of a picture; expected times"
        )
    if dataset.width * dataset.height > MOST_CELLS:
        raise UserError(
            f"{dataset.width} x {dataset.height} cells; at most {MOST_CELLS} are read: expected a "
            "part of it, as gdalwarp -te cuts out"
        )
    rows, columns = dataset.block_shapes[0]
    size = rows * max(columns, dataset.width) * kind.itemsize
    if size > _MOST_BYTES:
        raise UserError(
            f"blocks of {columns} x {rows} cells, {size} bytes in a row of them; at most "
            f"{_MOST_BYTES} are decoded at a time: expected smaller ones, as gdal_translate -co "
            "TILED=YES writes"
        )


def _factor(part: _Part) -> int:
    """How many cells along each side are taken together."""
    return math.ceil(max(part[2:]) / KEPT_SIDE)


def _burnt(times: np.ndarray, whole: _Part) -> _Part:
    """The part of a raster that ever burns, with a block around it; of the times of its blocks."""
    factor, burnt = _factor(whole), np.isfinite(times)
    if not burnt.any():
        return whole
    found: list[tuple[int, int]] = []
    for axis in (0, 1):
        at = np.flatnonzero(burnt.any(1 - axis))
        first, end = max(at[0] - 1, 0) * factor, min((at[-1] + 2) * factor, whole[2 + axis])
        found.append((int(first), int(end - first)))
    return found[0][0], found[1][0], found[0][1], found[1][1]


def _read(dataset: Any, part: _Part) -> tuple[np.ndarray, Any]:
    """Times of a part, strip by strip, and where they are."""
    windows = library("rasterio.windows", "GeoTIFF")
    first, left, count, width = part
    factor = _factor(part)
    # Whole blocks at a time, or each would be decoded again for the next strip.
    tall = factor * math.ceil(max(_STRIP // width, dataset.block_shapes[0][0]) / factor)
    kept: list[np.ndarray] = []
    for top in range(0, count, tall):
        window = windows.Window(left, first + top, width, min(tall, count - top))
        values = dataset.read(1, window=window)
        never = None if dataset.nodata is None else values == dataset.nodata
        if _masked(dataset):
            never = dataset.read_masks(1, window=window) == 0
        if never is not None and never.all():  # most of a large raster
            values, never = np.full(values.shape, np.inf, np.float32), None
        times = _earliest(clean(values, never), factor).astype(np.float64)
        kept.append(times * dataset.scales[0] + dataset.offsets[0])
    at = dataset.transform * dataset.transform.translation(left, first)
    return np.concatenate(kept), at * at.scale(factor)


def _masked(dataset: Any) -> bool:
    flags = [flag.name for flag in dataset.mask_flag_enums[0]]
    return "per_dataset" in flags or "alpha" in flags


def _earliest(times: np.ndarray, factor: int) -> np.ndarray:
    """The minimum of each block of factor x factor; blocks at the far edges may be smaller."""
    if factor == 1:
        return times
    rows = np.stack([times[k : k + factor].min(0) for k in range(0, len(times), factor)])
    return np.minimum.reduceat(rows, np.arange(0, times.shape[1], factor), axis=1)
