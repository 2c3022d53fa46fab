"""Decides which values of a raster are arrival times: NODATA, plateaus, days, states."""

import re

import numpy as np

from emberlink.envs.fire_files.config import FileFireConfig
from emberlink.envs.fire_files.grid import beginnings
from emberlink.envs.utils.errors import UserError

_MAX_TIME = 1e12
_NEVER = (-9999.0, -1.0)  # NODATA of FARSITE and FlamMap, and of ELMFIRE
_VOID = 1e30  # a number beyond it is NODATA although not declared, such as -3.4e38
_UNITS = {
    "seconds": r"s|secs?|seconds?",
    "minutes": r"mins?|minutes?",
    "hours": r"h|hrs?|hours?",
    "days": r"d|days?",
    "day_of_year": r"days? of (the )?year|doy|julian days?",
    "steps": r"steps?|time ?steps?",
}
_NO_TIME = r"m|ft|feet|foot|met(er|re)s?|deg(ree)?s?|%|percent|.+/.+"


def unit_of(declared: str, config: FileFireConfig, what: str) -> tuple[str, str]:
    """Returns the unit of a raster's times, and the date in `seconds since 2012-09-09`, or "".

    Args:
        declared: unit that the file declares; empty if none.
        what: the band or variable, for messages.
    """
    name, _, since = declared.strip().partition(" since ")
    known = next((u for u, form in _UNITS.items() if re.fullmatch(form, name, re.IGNORECASE)), None)
    if known is None and re.fullmatch(_NO_TIME, name, re.IGNORECASE):
        raise UserError(f"{what} is in {name[:20]}, no unit of time; expected arrival times")
    if known is None and config.units is None:
        raise UserError(
            f"the unit of {what} is not known; expected fire.units=minutes (FARSITE, FlamMap), "
            "seconds (ELMFIRE, WRF-SFIRE), hours, days, day_of_year or steps"
        )
    if (
        known
        and config.units not in (None, known)
        and {known, config.units}
        != {
            "days",
            "day_of_year",
        }
    ):
        raise UserError(f"{what} is in {known}; expected fire.units={known}, not {config.units}")
    return config.units or str(known), since.strip()


def arrival(
    values: np.ndarray, nodata: np.ndarray | None, config: FileFireConfig, *, in_bank: bool = False
) -> np.ndarray:
    """Returns arrival times, inf in cells that never burn, float32 or float64.

    Args:
        values: [rows, columns] of a file, any real type.
        nodata: mask of the NODATA that the file declares.
        in_bank: whether inf says which cells never burn, and all others may burn at once.
    """
    times = np.array(values, dtype=np.result_type(values, np.float32))
    if nodata is not None:
        times[nodata] = np.inf
    times[np.isin(times, config.never or ())] = np.inf
    odd = ~(times >= 0) | ((times > _MAX_TIME) & (times < np.inf))
    found = times[odd]
    wrong = found[~(np.isnan(found) | (np.abs(found) > _VOID) | np.isin(found, _NEVER))]
    if len(wrong):
        raise UserError(
            f"{wrong[0]:g} (in {(wrong == wrong[0]).sum()} cells) is not an arrival time; expected "
            f"0 or more, or fire.unburned={wrong[0]:g} for cells that do not burn"
        )
    times[odd] = np.inf
    check_spreads(times, may_stand=in_bank)
    if config.never is None:
        _check_plateau(times, of_all=in_bank)
    return times


def check_spreads(times: np.ndarray, *, may_stand: bool = False) -> None:
    """Checks that cells burn, more than one and, unless they `may_stand`, one after the other."""
    burning = times[np.isfinite(times)]
    if len(burning) < 2:
        what = "a single cell burns" if len(burning) else "no cell burns: NODATA everywhere"
        raise UserError(f"{what}; expected arrival times of a fire that spreads")
    if burning.min() == burning.max() and not (may_stand and len(burning) < times.size):
        raise UserError(
            f"all {len(burning)} cells burn at {burning[0]:g}, at once; expected one that spreads"
        )


def _check_plateau(times: np.ndarray, *, of_all: bool) -> None:
    """Asks about a first, last or most frequent value that may stand for cells that do not burn."""
    values, counts = np.unique(times[np.isfinite(times)], return_counts=True)
    cells = times.size if of_all else counts.sum()
    odd = {int(i) for i in np.flatnonzero(counts > 0.5 * cells)}
    for end, rest in ((0, slice(1, None)), (-1, slice(0, -1))) if len(values) > 3 else ():
        others = values[rest]
        gap = abs(values[end] - others[end]) > others[-1] - others[0]
        often = counts[end] > max(0.1 * cells, 3 * counts[rest].max())
        if (gap or often) and not of_all:
            odd.add(end % len(values))
    if odd:
        some = [f"{values[i]:g}" for i in sorted(odd)]
        share = [
            f"{v} ({100 * counts[i] / cells:.0f} % of the cells)"
            for i, v in zip(sorted(odd), some, strict=True)
        ]
        others = np.delete(values, sorted(odd))
        key = f"'fire.unburned=[{','.join(some)}]'" if len(odd) > 1 else f"fire.unburned={some[0]}"
        between = f"{others.min():g} to {others.max():g}" if len(others) else "none"
        raise UserError(
            f"{' and '.join(share)} may stand for cells that do not burn (others: {between}); "
            f"expected {key}, or fire.unburned=none if they burn then"
        )


def check_states(maps: np.ndarray) -> None:
    """Asks about maps that hold whole numbers of a few states, and no cell that never burns."""
    few = np.unique(maps[:: max(1, len(maps) // 8)])
    if len(maps) > 2 and len(few) <= 6 and np.isfinite(few).all() and (few % 1 == 0).all():
        states, counts = np.unique(maps, return_counts=True)
        share = [
            f"{s:g} ({100 * n / maps.size:.0f} %)" for s, n in zip(states, counts, strict=True)
        ]
        raise UserError(
            f"{len(maps)} maps of the states {', '.join(share)}, and no inf, never; "
            "expected arrival times of fires, or fire.kind=masks for a map of states per time"
        )


def first_burning(maps: np.ndarray, config: FileFireConfig) -> tuple[np.ndarray, str]:
    """Returns the number of the first map in which each cell is not unburnt, and what to say."""
    states = np.unique(maps)
    listed = ", ".join(f"{state:g}" for state in states[:12])
    if config.never is None and not np.isin(states, (0, 1, 2)).all():
        raise UserError(
            f"states {listed}; expected fire.unburned, those that are no fire, such as "
            "'fire.unburned=[0,3,4,5]' of SimFire's with its lines"
        )
    burns = ~np.isin(maps, (0,) if config.never is None else config.never)
    times = np.where(burns.any(0), burns.argmax(0), np.inf)
    check_spreads(times)
    return times, f"{len(maps)} maps of the states {listed}, rows from north to south"


def doubts(times: np.ndarray, unit: str) -> list[str]:
    """Returns signs that the values of a raster are no arrival times."""
    burns = np.isfinite(times)
    order, places = np.sort(times[burns]), beginnings(times)
    first, lasts = float(order[0]), float(order[-1] - order[0])
    outer = np.pad(burns, 1)
    inside = outer[:-2, 1:-1] & outer[2:, 1:-1] & outer[1:-1, :-2] & outer[1:-1, 2:]
    edge = times[burns & ~inside]
    rank = np.searchsorted(order, edge) + np.searchsorted(order, edge, side="right")
    signs = {
        "all values are between 0 and 1": order[-1] <= 1 and unit != "days",
        f"it begins at {first:g} {unit} and lasts for {lasts:g}": first > lasts and unit != "days",
        f"it begins at {places} places": places > 10,
        "it begins at its edge and ends in its middle": rank.mean() / 2 < 0.35 * len(order),
    }
    return [sign for sign, is_so in signs.items() if is_so]
