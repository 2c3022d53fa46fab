"""Times of perimeters, from the columns of their table."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np

from emberlink.envs.fire_files.times import Clock, Units, in_utc, parse_time
from emberlink.envs.utils.errors import UserError

ELAPSED: dict[str, Units] = {
    "elapsed_mi": "minutes",
    "elapsed_min": "minutes",
    "elapsed_minutes": "minutes",
    "minutes": "minutes",
    "elapsed_s": "seconds",
    "seconds": "seconds",
    "elapsed_hours": "hours",
    "hours": "hours",
    "days": "days",
}
"""Columns of elapsed time, in lower case; the name says the unit."""
CALENDAR = (
    *("poly_polygondatetime", "polygondatetime", "perimeterdatetime", "perdatetime", "perdattime"),
    *("gdb_from_date", "datetime", "date_time", "timestamp", "acq_datetime", "acq_date"),
    *("date_", "date", "time", "t"),
)
"""Columns of the time at which a perimeter was mapped, in lower case."""
EDITED = ("poly_datecurrent", "datecurrent")
"""Columns of the time at which a record was changed, used where a perimeter has no other time."""
_DBF_LENGTH = 10  # letters of a column's name that a .dbf keeps
_FIRST_MS, _LAST_MS = 1e11, 2.5e14  # numbers in between are milliseconds since 1970
_MAX_TIME = 1e12


@dataclass(frozen=True)
class Times:
    """The time of each feature of a file."""

    values: np.ndarray
    """float64 [features]"""
    clock: Clock


def perimeter_times(frame: Any, wanted: str | None, unit: Units | None) -> Times:
    """Reads the time of each feature.

    Args:
        frame: a table with a column per attribute.
        wanted: `fire.time_field`; None takes the only column with a known name.
        unit: `fire.units`.

    Raises:
        UserError: no column, several columns, or a value that is not a time.
    """
    names = {str(name).lower(): str(name) for name in frame.columns if name != frame.geometry.name}
    if wanted is not None:
        if wanted.lower() not in names:
            raise UserError(f"no column {wanted!r} (fire.time_field); there are {_list(names)}")
        return _of_column(frame, names[wanted.lower()], unit)
    found = _present(names, tuple(ELAPSED))
    if not found and {"month", "day", "hour"} <= set(names):
        return _farsite(frame, names)
    found = found or _present(names, CALENDAR)
    edited = _present(names, EDITED)
    if {"date_", "time_"} <= set(names) and found == [names["date_"]]:
        return _geomac(frame, names["date_"], names["time_"])
    if len(found) > 1:
        raise UserError(
            f"the columns {', '.join(found)} may hold the times; expected fire.time_field, such as "
            f"fire.time_field={found[0]}"
        )
    if not found and not edited:
        raise UserError(
            "which column holds the times is not known; expected fire.time_field, one of "
            f"{_list(names)}"
        )
    return _of_column(frame, (found or edited)[0], unit, instead=edited if found else [])


def _present(names: dict[str, str], known: Sequence[str]) -> list[str]:
    """Returns the columns with a known name, also as a .dbf cuts it."""
    short = {name[:_DBF_LENGTH] for name in known if len(name) > _DBF_LENGTH}
    return [names[name] for name in names if name in known or name in short]


def _list(names: dict[str, str]) -> str:
    return ", ".join(list(names.values())[:30]) or "none"


def _of_column(frame: Any, name: str, unit: Units | None, instead: Sequence[str] = ()) -> Times:
    column = frame[name]
    for other in instead:
        if other != name:
            column = column.where(column.notna(), frame[other])
    empty = np.flatnonzero(column.isna().to_numpy())
    if len(empty):
        raise UserError(f"feature {empty[0]} has no time in {name}; expected one in each")
    values = column.tolist()
    if name.lower() in ELAPSED or _are_elapsed(values):
        return _elapsed(values, name, unit)
    return _calendar([_date(value, i, name) for i, value in enumerate(values)], name)


def _number(value: Any) -> float | None:
    try:
        return float(value)
    except (TypeError, ValueError):
        return None


def _are_elapsed(values: Sequence[Any]) -> bool:
    """Tells whether all values are numbers that are not dates."""
    numbers = [_number(value) for value in values]
    if any(number is None for number in numbers):
        return False
    return not all(_is_date(number) for number in numbers if number is not None)


def _is_date(number: float) -> bool:
    """Tells whether a number is a date in digits, or milliseconds since 1970."""
    if not np.isfinite(number) or number != np.floor(number):
        return False
    digits = f"{number:.0f}"
    plausible = "1900" <= digits[:4] <= "2100" and "01" <= digits[4:6] <= "12"
    return (len(digits) in (8, 12, 14) and plausible) or _FIRST_MS < number < _LAST_MS


def _date(value: Any, feature: int, name: str) -> datetime:
    number = _number(value)
    if number is not None and _is_date(number):
        digits = f"{number:.0f}"
        plausible = "1900" <= digits[:4] <= "2100" and len(digits) in (8, 12, 14)
        if not plausible:
            return datetime.fromtimestamp(number / 1000, UTC)
        value = digits
    try:
        return parse_time(str(value))
    except UserError:
        raise UserError(
            f"feature {feature} has {name}={str(value)[:40]!r}, which is not a date; expected such "
            "as 2020-08-19T13:00"
        ) from None


def _elapsed(values: Sequence[Any], name: str, unit: Units | None) -> Times:
    numbers: list[float] = []
    for feature, value in enumerate(values):
        number = _number(value)
        if number is None or not 0 <= number <= _MAX_TIME:
            raise UserError(
                f"feature {feature} has {name}={str(value)[:40]}; expected a time of 0 or more"
            )
        numbers.append(number)
    known = ELAPSED.get(name.lower())
    if known and unit and unit != known:
        raise UserError(f"{name} is in {known}; expected fire.units={known}, not {unit}")
    if not (known or unit):
        raise UserError(
            f"the unit of {name} is not known; expected fire.units=minutes, seconds, hours, days "
            "or steps"
        )
    return Times(np.array(numbers), Clock(known or unit or "minutes"))


def _calendar(dates: Sequence[datetime], name: str) -> Times:
    """Returns minutes since the first date."""
    aware = [date.tzinfo is not None for date in dates]
    if any(aware) and not all(aware):
        raise UserError(
            f"{name}: feature {aware.index(True)} has a time zone and feature "
            f"{aware.index(False)} has none; expected all or none"
        )
    try:
        dates = [in_utc(date) for date in dates]
    except UserError as error:
        raise UserError(f"{name}: {error}") from None
    first = min(dates)
    values = [(date - first) / timedelta(minutes=1) for date in dates]
    return Times(np.array(values), Clock("minutes", first))


def _geomac(frame: Any, date_name: str, time_name: str) -> Times:
    """Joins GeoMAC's columns: a date, and the time of day as 2300, 155 or 23:00."""
    dates: list[datetime] = []
    for feature, (date, time) in enumerate(zip(frame[date_name], frame[time_name], strict=True)):
        digits = str(time).strip().removesuffix(".0").replace(":", "").zfill(4)
        text = f"{date_name}={str(date)[:40]}, {time_name}={str(time)[:40]}"
        try:
            day = parse_time(str(date))
            dates.append(day.replace(hour=0, minute=0, second=0) + _time_of_day(digits[:4]))
        except UserError:
            raise UserError(
                f"feature {feature} has {text}; expected a date and a time such as 2300"
            ) from None
    return _calendar(dates, f"{date_name}, {time_name}")


def _time_of_day(digits: str) -> timedelta:
    """Reads a time of day such as 1300."""
    if not digits.isdecimal() or int(digits[:-2] or 0) > 24 or int(digits[-2:]) > 59:
        raise UserError(f"{digits!r} is not a time of day")
    return timedelta(hours=int(digits[:-2] or 0), minutes=int(digits[-2:]))


def _farsite(frame: Any, names: dict[str, str]) -> Times:
    """Reads FARSITE's columns Month, Day and Hour (1300 is 13:00), which hold no year."""
    keys = ("month", "day", "hour")
    rows = [[_number(value) for value in frame[names[key]]] for key in keys]
    months = [month for month in rows[0] if month is not None]
    # A fire from December to January changes the year; no fire lasts for half a year.
    over = any(month >= 11 for month in months) and any(month <= 2 for month in months)
    dates: list[datetime] = []
    for feature, (month, day, hour) in enumerate(zip(*rows, strict=True)):
        try:
            year = 2005 if over and int(month or 0) <= 6 else 2004
            time = _time_of_day(f"{hour:04.0f}")
            dates.append(datetime(year, int(month or 0), int(day or 0)) + time)
        except (TypeError, ValueError, OverflowError):
            at = (f"{names[key]}={str(frame[names[key]].iloc[feature])[:40]}" for key in keys)
            raise UserError(
                f"feature {feature} has {', '.join(at)}; expected a date and a time such as 1300"
            ) from None
    return _calendar(dates, "Month, Day, Hour")
