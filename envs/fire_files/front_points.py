"""The paper's text: a line per iteration, `x,y,intensity,` for each point of the fire's front."""

from pathlib import Path

import numpy as np

from emberlink.envs.utils.errors import UserError

from .arrival_raster import Clock, RasterSource, Units
from .geotiff import check_spreads

SIDE = 30
"""cells of the paper's map"""
SKIPPED = 6000
"""lines before the one that is step 0"""
_ALLOWED = b"0123456789+-.eE, \t\r\n"
_PLUS = ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1))


def read_front_points(path: Path, unit: Units = "steps") -> RasterSource:
    """The paper's fire: each point of the front stamps a plus of five cells on a map of 30 x 30.

    A point's cell along x and y is int(v - (30 - 1) / 3). A cell burns from the first line that
    stamps it; lines before the 6000th are skipped, and that one is time 0.

    Args:
        path: the text.
        unit: time from one line to the next.

    Raises:
        ValueError: one line that names the file's line that is wrong.
    """
    times = np.full((SIDE, SIDE), np.inf)
    count = 0
    with path.open("rb") as lines:
        for line in lines:
            if count >= SKIPPED:
                _stamp(times, _points(line, count + 1), count - SKIPPED)
            count += 1
    if count <= SKIPPED:
        raise UserError(
            f"{count} lines; expected more than {SKIPPED}, as the first {SKIPPED} are skipped"
        )
    if not np.isfinite(times).any():
        raise UserError(f"no point lies on the map of {SIDE} x {SIDE} cells: there is no fire")
    check_spreads(times)
    # Rows run north to south, as in every raster.
    return RasterSource(
        times.T[::-1].copy(), (1.0, 0.0, 0.0, 0.0, -1.0, float(SIDE)), Clock(unit), whole=True
    )


def _points(line: bytes, number: int) -> np.ndarray:
    """The triples of a line, [points, 3]."""
    texts = line.strip().split(b",")
    if texts[-1].strip() == b"":
        texts.pop()
    try:
        if line.translate(None, _ALLOWED):
            raise ValueError
        values = np.array([float(text) for text in texts])
    except ValueError:
        wrong = repr((line.translate(None, _ALLOWED) or line)[:20].decode("latin-1"))
        raise UserError(
            f"line {number}: {wrong}; expected numbers: x,y,intensity, of each point"
        ) from None
    if len(values) % 3:
        raise UserError(
            f"line {number}: {len(values)} numbers; expected three for each point: x,y,intensity,"
        )
    if not np.isfinite(values).all() or np.abs(values).max(initial=0) > 1e9:
        raise UserError(f"line {number}: a number is not finite; expected x,y,intensity,")
    return values.reshape(-1, 3)


def _stamp(times: np.ndarray, points: np.ndarray, time: int) -> None:
    """Marks the cells of the points, where no earlier line has, [x, y]."""
    cells = np.trunc(points[:, :2] - (SIDE - 1) / 3).astype(np.int64)
    for x, y in _PLUS:
        i, j = cells[:, 0] + x, cells[:, 1] + y
        inside = (i >= 0) & (j >= 0) & (i < SIDE) & (j < SIDE)
        np.minimum.at(times, (i[inside], j[inside]), float(time))
