"""Files that hold maps of the whole grid: banks (NumPy, GeoTIFF) and the paper's text.

The paper's text has a line per iteration, with `x,y,intensity,` for each point of the front.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from emberlink.envs.config import SIDES
from emberlink.envs.fire_files.config import Clock, Units
from emberlink.envs.fire_files.projection import first_line
from emberlink.envs.fire_files.raster_source import RasterSource, check_spreads
from emberlink.envs.fire_files.rasters import check_blocks, clean, open_raster
from emberlink.envs.utils.errors import UserError

MAX_CELLS = 300_000_000
"""Maximum number of cells of all fires of a bank: 1.2 GB."""
_MAX_FACTS = 50_000_000  # bytes of the .json beside an .npy
_SIDE = 30  # cells along a side of the paper's map
_SKIPPED = 6000  # lines of the paper's text before step 0
_MAX_COORDINATE = 1e9
_PLUS = ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1))


@dataclass(frozen=True)
class Bank:
    """Fires on a grid, in steps."""

    fires: Sequence[np.ndarray] | np.ndarray
    """[rows, columns] each, rows from north to south, as in the file"""
    horizon: int | None
    """number of steps for which the bank was written; None if unknown"""


def read_numpy_bank(path: Path) -> Bank:
    """Reads a NumPy file, [fires, X, Y] or [X, Y].

    Raises:
        UserError: the file holds another array.
    """
    try:
        # Memory-mapped, so that a wrong header allocates nothing.
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except Exception as error:  # a damaged header raises many types
        raise UserError(f"{first_line(error)}; expected an array in NumPy's format") from None
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "iuf":
        kind = getattr(array, "dtype", type(array).__name__)
        raise UserError(f"values of type {kind}; expected numbers")
    fires = array[None] if array.ndim == 2 else array
    if fires.ndim != 3 or len(fires) == 0:
        raise UserError(f"an array of shape {list(array.shape)}; expected [fires, X, Y]")
    _check_size(*fires.shape)
    return Bank(fires.transpose(0, 2, 1)[:, ::-1], _horizon(_facts(path.with_suffix(".json"))))


def read_geotiff_bank(path: Path) -> Bank | None:
    """Reads a GeoTIFF with a band per fire, tagged units=steps and without a projection.

    Returns:
        The bank; None if the tag is missing or the file has a projection.

    Raises:
        UserError: the file is damaged, or of another size or type.
    """
    with open_raster(path) as dataset:
        tags = dataset.tags()
        if tags.get("units") != "steps" or dataset.crs is not None:
            return None
        _check_size(dataset.count, dataset.width, dataset.height)
        if np.dtype(dataset.dtypes[0]).kind not in "iuf":
            raise UserError(f"values of type {dataset.dtypes[0]}; expected numbers")
        if {*dataset.scales} != {1.0} or {*dataset.offsets} != {0.0}:
            raise UserError("scaled values; expected a bank without scale and offset")
        check_blocks(dataset)
        nodata, bands = dataset.nodata, dataset.read()
    fires = bands if nodata is None else [np.where(band == nodata, np.inf, band) for band in bands]
    return Bank(fires, _horizon(tags))


def map_of_grid(times: np.ndarray) -> RasterSource:
    """Returns a fire of a bank.

    Raises:
        UserError: a number is not a time, or no fire spreads.
    """
    times = clean(times)
    check_spreads(times, may_stand=True)
    return _whole_map(times, "steps")


def read_front_points(path: Path, unit: Units) -> RasterSource:
    """Reads the paper's text: each point of the front marks five cells on a map of 30 x 30.

    The cell of a point is int(v - (30 - 1) / 3) along x and y; the four cells beside it burn too.
    A cell burns from the first line that marks it. Line 6000 is time 0.

    Args:
        path: the text.
        unit: the time from one line to the next.

    Raises:
        UserError: a line does not hold numbers in threes, or there is no fire.
    """
    times = np.full((_SIDE, _SIDE), np.inf)  # [x, y]
    count = 0
    with path.open("rb") as lines:
        for count, line in enumerate(lines, 1):
            if count > _SKIPPED:
                _mark(times, _points(line, count), count - 1 - _SKIPPED)
    if count <= _SKIPPED:
        raise UserError(
            f"{count} lines; expected more than {_SKIPPED}, as the first {_SKIPPED} are skipped"
        )
    if not np.isfinite(times).any():
        raise UserError(f"no point lies on the map of {_SIDE} x {_SIDE} cells: there is no fire")
    check_spreads(times)
    return _whole_map(times.T[::-1], unit)


def _whole_map(times: np.ndarray, unit: Units) -> RasterSource:
    return RasterSource(times, (0.0, float(len(times))), (1.0, 1.0), Clock(unit), whole=True)


def _check_size(fires: int, width: int, height: int) -> None:
    if not all(SIDES[0] <= side <= SIDES[1] for side in (width, height)):
        raise UserError(
            f"fires of {width} x {height} cells; expected {SIDES[0]} to {SIDES[1]} a side"
        )
    if fires * width * height > MAX_CELLS:
        raise UserError(f"{fires} fires of {width} x {height}; at most {MAX_CELLS} cells are read")


def _facts(path: Path) -> Any:
    """Returns the content of the .json beside a NumPy bank, None if there is none."""
    try:
        if path.is_file() and path.stat().st_size <= _MAX_FACTS:
            return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        pass  # the .json of another program
    return None


def _horizon(facts: Any) -> int | None:
    try:
        return int(facts["horizon"])
    except (KeyError, TypeError, ValueError, OverflowError):
        return None


def _points(line: bytes, number: int) -> np.ndarray:
    """Returns the triples of a line, [points, 3]."""
    texts = line.strip().removesuffix(b",").split(b",")
    try:
        values = np.array([float(text) for text in texts if texts != [b""]])
    except ValueError:
        text = line[:20].decode("latin-1")
        raise UserError(f"line {number}: {text!r}; expected x,y,intensity, of each point") from None
    if len(values) % 3:
        raise UserError(
            f"line {number}: {len(values)} numbers; expected three for each point: x,y,intensity,"
        )
    if not (np.abs(values) < _MAX_COORDINATE).all():
        raise UserError(f"line {number}: a number is not finite; expected x,y,intensity,")
    return values.reshape(-1, 3)


def _mark(times: np.ndarray, points: np.ndarray, time: int) -> None:
    """Marks the cells of the points that no earlier line has marked."""
    cells = np.trunc(points[:, :2] - (_SIDE - 1) / 3).astype(np.int64)
    for x, y in _PLUS:
        i, j = cells[:, 0] + x, cells[:, 1] + y
        inside = (i >= 0) & (j >= 0) & (i < _SIDE) & (j < _SIDE)
        np.minimum.at(times, (i[inside], j[inside]), float(time))
