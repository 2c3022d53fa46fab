"""Finds signs that a raster holds something other than arrival times.

Elevation, fuel models, flame lengths, rates of spread and burn probabilities are rasters of the
same form. A raster without such a sign may still be one of these.
"""

import re
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from scipy.ndimage import label, minimum_filter

from emberlink.envs.fire_files.config import SECONDS, Units

MAX_BEGINNINGS = 10
"""Places at which the fire of a raster may begin without a doubt."""
_NAMES = ("elevation", "altitude", "slope", "aspect", "canopy", "crown", "fuel", "fbfm", "flame")
_NAMES += ("intensity", "probability", "burnprob", "rateofspread", "spreadrate")
_WORDS = ("dem", "dtm", "dsm", "ros", "flin")  # too short to be looked for within other words
_TIMES = ("arrival", "time", "toa", "hour", "minute", "date")
_NOT_TIME = re.compile(r"m|met(er|re)s?|ft|foot|feet|deg(ree)?s?|%|percent|.*/.*", re.IGNORECASE)
_FUEL_MODELS = (*range(1, 14), 91, 92, 93, 98, 99, *range(101, 110), *range(121, 125))
_FUEL_MODELS += (*range(141, 150), *range(161, 166), *range(181, 190), *range(201, 205))
"""Numbers of Anderson's 13 fuel models and of Scott and Burgan's 40."""
_CLASSES = 60  # whole numbers that a raster of classes has at most
_FASTEST = 40.0  # metres a minute by which the radius of a burnt area grows at most
_MIDDLE = 0.35  # mean rank of the times at the edge, below which a fire would end in its middle


def doubts_of_names(texts: Iterable[str], unit: str = "") -> Iterator[str]:
    """Yields reasons to doubt that names (of a band, a tag, a file) mean arrival times.

    Args:
        texts: any text; one that names a time is no sign.
        unit: unit that the file declares.
    """
    for text in texts:
        letters = re.sub(r"[^a-z]", "", text.lower())
        words = [word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+", text)]
        if any(name in letters for name in _TIMES):
            continue
        found = [name for name in _NAMES if name in letters]
        found += [word for word in words if word in _WORDS]
        if found:
            yield f"its name is {text[:60]!r}"
            break
    if _NOT_TIME.fullmatch(unit.strip()):
        yield f"its values are in {unit.strip()[:20]}"


def doubts_of_values(times: np.ndarray, unit: Units) -> Iterator[str]:
    """Yields reasons to doubt that the values of a raster are arrival times.

    Args:
        times: [rows, columns] as in the file, inf for never.
        unit: unit of the times.
    """
    burns = np.isfinite(times)
    burning = times[burns]
    first, last = float(burning.min()), float(burning.max())
    if last <= 1 and unit != "days" and (burning % 1).any():
        yield "all values are between 0 and 1"
    if _looks_like_classes(times, burning, unit):
        yield "whole numbers in patches, as of fuel models"
    if first > last - first and unit != "days":  # days may be those of the year
        yield f"it would begin at {first:g} {unit} and last for {last - first:g}"
    if burns.all() and first > _steps_between(times).max():
        yield f"every cell would burn, the first at {first:g} {unit}"
    edge, order = times[_edge(burns)], np.sort(burning)
    rank = np.searchsorted(order, edge) + np.searchsorted(order, edge, side="right")
    if rank.mean() / 2 < _MIDDLE * len(order):
        yield "it would begin at its edge and end in its middle"


def doubts_of_growth(times: np.ndarray, cell: tuple[float, float], unit: Units) -> Iterator[str]:
    """Yields a sign if the burnt area grows faster than those of known fires.

    Args:
        times: [rows, columns] on a plane, inf for never.
        cell: width and height of a cell, metres.
        unit: unit of the times; nothing is known of steps.
    """
    burning = times[np.isfinite(times)]
    if unit == "steps":
        return
    minutes = float(burning.max() - burning.min()) * SECONDS[unit] / 60
    radius = np.sqrt(len(burning) * cell[0] * cell[1] / np.pi)
    if radius > _FASTEST * minutes:
        yield f"the fire would spread by {radius / minutes * 0.06:.3g} km/h on all sides"


def begins_at_zero(times: np.ndarray) -> bool:
    """Returns whether the first cell burns no later than the front takes to cross a cell.

    Args:
        times: arrival times, [rows, columns], inf for never.
    """
    first = times.min()
    row, column = np.unravel_index(times.argmin(), times.shape)
    around = times[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
    later = around[np.isfinite(around) & (around > first)]
    return bool(0 <= first <= (later - first).max(initial=0.0))


def beginnings(times: np.ndarray) -> int:
    """Returns the number of places that burn before all cells around them.

    Args:
        times: arrival times, [rows, columns]; 2000 x 2000 cells around the first are looked at.
    """
    row, column = np.unravel_index(times.argmin(), times.shape)
    times = times[max(row - 1000, 0) : row + 1000, max(column - 1000, 0) : column + 1000]
    burns, earliest = np.isfinite(times), times == minimum_filter(times, 3)
    # Of cells that burn at the same time, one may have an earlier neighbour: no beginning.
    later = minimum_filter(np.where(burns & ~earliest, times, np.inf), 3) == times
    places: Any = label(burns & earliest, np.ones((3, 3)))
    reached = np.unique(places[0][burns & earliest & later])
    return int(places[1] - len(reached))


def _looks_like_classes(times: np.ndarray, burning: np.ndarray, unit: Units) -> bool:
    """Tells whether most neighbours have equal whole numbers, and the others unrelated ones.

    Whole hours or days lie in such patches, too.
    """
    classes = np.unique(burning)
    if unit in ("hours", "days") or len(classes) > _CLASSES or (classes % 1).any():
        return False
    number = np.where(np.isfinite(times), np.searchsorted(classes, times), -1)
    pairs = [(number[1:], number[:-1]), (number[:, 1:], number[:, :-1])]
    apart = np.concatenate([np.abs(a - b)[(a >= 0) & (b >= 0)] for a, b in pairs])
    if (apart == 0).mean() < 0.5:
        return False
    if np.isin(classes, _FUEL_MODELS).all():
        return True
    return bool((apart > 1).sum() > 0.25 * (apart > 0).sum())


def _steps_between(times: np.ndarray) -> np.ndarray:
    """Returns the differences between the first cell and those around it."""
    row, column = np.unravel_index(times.argmin(), times.shape)
    around = times[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
    return around - times[row, column]


def _edge(burns: np.ndarray) -> np.ndarray:
    """Returns the mask of burnt cells beside one that never burns, or at the edge of the raster."""
    outer = np.pad(burns, 1)
    inside = outer[:-2, 1:-1] & outer[2:, 1:-1] & outer[1:-1, :-2] & outer[1:-1, 2:]
    return burns & ~inside
