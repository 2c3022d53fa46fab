"""Rasters of arrival times: what is common to them, and GeoTIFF."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from .arrival import Clock, RasterSource, Units
from .geo import Bounds, first_line, library, to_plane

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
_CACHE = 100_000_000  # bytes that GDAL keeps of what it decoded; its default is 5 % of the memory


def read_geotiff(path: Path, unit: Units | None, crs: str | None) -> RasterSource:
    """Arrival times from a GeoTIFF of one band; the tag `units` of ours stands for `unit`.

    Raises:
        ValueError: one line that names what is wrong.
    """
    rasterio = library("rasterio", "GeoTIFF")
    try:
        with rasterio.Env(GDAL_CACHEMAX=_CACHE), rasterio.open(path, driver="GTiff") as dataset:
            _check_band(dataset)
            times, factor = _read_strips(dataset)
            tags = dataset.tags()
            transform = dataset.transform * dataset.transform.scale(factor)
            source_crs = dataset.crs
    except (rasterio.errors.RasterioError, OSError) as error:
        raise ValueError(f"{first_line(error)}; expected a whole GeoTIFF") from None
    unit = unit or ("steps" if tags.get("units") == "steps" else None)
    return raster_source(times, transform, source_crs, unit, crs)


def clean(times: np.ndarray, never: np.ndarray | None = None) -> np.ndarray:
    """Arrival times in which what never burns is inf, float32 or float64.

    Args:
        times: as a file has them, any real type.
        never: where the file itself says so.

    Raises:
        ValueError: a number is no time.
    """
    times = np.array(times, dtype=np.result_type(times, np.float32))
    if never is not None:
        np.copyto(times, np.inf, where=never)
    odd = ~(times >= 0) | ((times > LATEST) & (times < np.inf))
    values = times[odd]
    wrong = ~(np.isnan(values) | (np.abs(values) > _VOID) | np.isin(values, NEVER))
    if wrong.any():
        raise ValueError(
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
        raise ValueError("no cell burns: NODATA everywhere; expected times of arrival")
    if len(burning) == 1:
        raise ValueError("a single cell burns; expected a fire that spreads")
    if burning.min() == burning.max() and not (may_stand and len(burning) < times.size):
        raise ValueError(
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
        raise ValueError(f"cells of {affine[0]:g} x {affine[4]:g}; expected a size above 0")
    if unit is None:
        raise ValueError(
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
        raise ValueError(
            f"{dataset.count} bands; expected one, or a bank of fires, tagged units=steps"
        )
    kind = np.dtype(dataset.dtypes[0])
    if kind.kind not in "iuf":
        raise ValueError(f"values of type {dataset.dtypes[0]}; expected real numbers")
    if kind.itemsize == 1 and dataset.nodata is None:
        raise ValueError(
            f"values of type {dataset.dtypes[0]} without NODATA, as of a picture; expected times"
        )
    if dataset.width * dataset.height > MOST_CELLS:
        raise ValueError(
            f"{dataset.width} x {dataset.height} cells; at most {MOST_CELLS} are read: expected a "
            "part of it, as gdalwarp -te cuts out"
        )


def _read_strips(dataset: Any) -> tuple[np.ndarray, int]:
    """Times, and how many cells along each side were taken together."""
    windows = library("rasterio.windows", "GeoTIFF")
    width, height = dataset.width, dataset.height
    factor = math.ceil(max(width, height) / KEPT_SIDE)
    # Whole blocks at a time, or each would be decoded again for the next strip.
    tall = factor * math.ceil(max(_STRIP // width, dataset.block_shapes[0][0]) / factor)
    kept: list[np.ndarray] = []
    for top in range(0, height, tall):
        window = windows.Window(0, top, width, min(tall, height - top))
        part = dataset.read(1, window=window)
        never = None if dataset.nodata is None else part == dataset.nodata
        if _masked(dataset):
            never = dataset.read_masks(1, window=window) == 0
        if never is not None and never.all():  # most of a large raster
            part, never = np.full(part.shape, np.inf, np.float32), None
        times = _earliest(clean(part, never), factor).astype(np.float64)
        kept.append(times * dataset.scales[0] + dataset.offsets[0])
    return np.concatenate(kept), factor


def _masked(dataset: Any) -> bool:
    flags = [flag.name for flag in dataset.mask_flag_enums[0]]
    return "per_dataset" in flags or "alpha" in flags


def _earliest(times: np.ndarray, factor: int) -> np.ndarray:
    """The minimum of each block of factor x factor; blocks at the far edges may be smaller."""
    if factor == 1:
        return times
    rows = np.stack([times[k : k + factor].min(0) for k in range(0, len(times), factor)])
    return np.minimum.reduceat(rows, np.arange(0, times.shape[1], factor), axis=1)
