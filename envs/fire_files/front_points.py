"""The paper's text: a line per iteration, `x,y,intensity,` for each point of the fire's front."""

from pathlib import Path

import numpy as np

from emberlink.envs.fire_files.raster_source import RasterSource, check_spreads
from emberlink.envs.fire_files.times import Clock, Units
from emberlink.envs.utils.errors import UserError

SIDE = 30
"""Cells along a side of the paper's map."""
SKIPPED = 6000
"""Lines before step 0."""
_MAX_COORDINATE = 1e9
_PLUS = ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1))


def read_front_points(path: Path, unit: Units = "steps") -> RasterSource:
    """Reads the paper's fire: each point of the front marks five cells on a map of 30 x 30.

    The cell of a point is int(v - (30 - 1) / 3) along x and y; the four beside it burn too. A cell
    burns from the first line that marks it. The first 6000 lines are skipped; line 6000 is time 0.

    Args:
        path: the text.
        unit: time from one line to the next.

    Raises:
        UserError: a line is not numbers in threes, or there is no fire.
    """
    times = np.full((SIDE, SIDE), np.inf)  # [x, y]
    count = 0
    with path.open("rb") as lines:
        for count, line in enumerate(lines, 1):
            if count > SKIPPED:
                _mark(times, _points(line, count), count - 1 - SKIPPED)
    if count <= SKIPPED:
        raise UserError(
            f"{count} lines; expected more than {SKIPPED}, as the first {SKIPPED} are skipped"
        )
    if not np.isfinite(times).any():
        raise UserError(f"no point lies on the map of {SIDE} x {SIDE} cells: there is no fire")
    check_spreads(times)
    return RasterSource(times.T[::-1], (0.0, float(SIDE)), (1.0, 1.0), Clock(unit), whole=True)


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
    cells = np.trunc(points[:, :2] - (SIDE - 1) / 3).astype(np.int64)
    for x, y in _PLUS:
        i, j = cells[:, 0] + x, cells[:, 1] + y
        inside = (i >= 0) & (j >= 0) & (i < SIDE) & (j < SIDE)
        np.minimum.at(times, (i[inside], j[inside]), float(time))
