"""Decides which values of a raster are arrival times: NODATA, plateaus, states, units."""

import re
from typing import Any

import numpy as np
from scipy.ndimage import binary_erosion

from emberlink.envs.fire_files.config import FileFireConfig
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
    unit = config.units or known
    if known is None and re.fullmatch(_NO_TIME, name, re.IGNORECASE):
        raise UserError(f"{what} is in {name[:20]}, no unit of time; expected arrival times")
    if unit is None:
        raise UserError(
            f"the unit of {what} is not known; expected fire.units=minutes (FARSITE, FlamMap), "
            "seconds (ELMFIRE, WRF-SFIRE), hours, days, day_of_year or steps"
        )
    if known not in (None, unit) and {known, unit} != {"days", "day_of_year"}:
        raise UserError(f"{what} is in {known}; expected fire.units={known}, not {unit}")
    return unit, since.strip()


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
    times[odd] = np.inf
    plateaus = _plateaus(times, in_bank=in_bank) if config.never is None else []
    asked = [*np.unique(wrong)[:5].tolist(), *plateaus]
    if asked:
        cells = times.size if in_bank else max(1, np.isfinite(times).sum() + len(wrong))
        parts = [(f"{value:g}", (values == value).sum() / cells) for value in asked]
        listed = " and ".join(f"{value} ({100 * part:.0f} % of the cells)" for value, part in parts)
        some = ",".join(value for value, _ in parts)
        key = f"'fire.unburned=[{some}]'" if len(parts) > 1 else f"fire.unburned={some}"
        others = times[np.isfinite(times) & ~np.isin(times, asked)]
        between = f"{others.min():g} to {others.max():g}" if len(others) else "none"
        raise UserError(
            f"{listed} may stand for cells that do not burn (others: {between}); expected {key}"
            + ("" if len(wrong) else ", or fire.unburned=none if they burn then")
        )
    check_spreads(times, may_stand=in_bank)
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


def _plateaus(times: np.ndarray, *, in_bank: bool) -> list[float]:
    """Returns values that may stand for cells that do not burn.

    They hold more than half of the cells; or are the first or last value, and far from the rest or
    frequent along the edge of the raster, where a fire has cells of many times.
    """
    finite = np.isfinite(times)
    values, counts = np.unique(times[finite], return_counts=True)
    cells = times.size if in_bank else counts.sum()
    odd = {int(i) for i in np.flatnonzero(counts > 0.5 * cells)} if len(values) > 1 else set()
    inner: Any = binary_erosion(finite)
    edge = times[finite & ~inner]
    for end, rest in ((0, slice(1, None)), (-1, slice(0, -1))):
        others = values[rest]
        if len(others) > 2 and not in_bank:
            far = abs(values[end] - others[end]) > others[-1] - others[0]
            often = counts[end] > max(0.1 * cells, 3 * counts[rest].max())
            if far or (often and (edge == values[end]).mean() > 0.5):
                odd.add(end % len(values))
    return [float(values[i]) for i in sorted(odd)]


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
