"""Reads the times of perimeters: calendar times as text, and columns of a table."""

import re
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from email.utils import parsedate_to_datetime
from typing import Any

import numpy as np

from emberlink.envs.fire_files.config import Clock, Units
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
"""Columns of elapsed time, in lower case, and the unit of each."""
CALENDAR = (
    *("poly_polygondatetime", "polygondatetime", "perimeterdatetime", "perdatetime", "perdattime"),
    *("gdb_from_date", "datetime", "date_time", "timestamp", "acq_datetime", "acq_date"),
    *("date_", "date", "time", "t", "begin"),
)
"""Columns of the time at which a perimeter was mapped, in lower case."""
_WHOLE = CALENDAR[: CALENDAR.index("acq_date")]  # with a date and a time of day
EDITED = ("poly_datecurrent", "datecurrent")
"""Columns of the time at which a record was changed, for perimeters without another time."""
_DATES = ("acq_date", "date", "time", "t", "begin")  # columns that may hold a date alone
_DBF_LENGTH = 10  # maximum length of a column's name in a .dbf
_MIN_MS = 1e11  # a number from here on is a date: milliseconds since 1970, or digits
_MIN_S, _MAX_S = 1e9, 1.9e9  # seconds since 1970: from September 2001 to March 2030
_CENTURIES = ("19", "20")  # the first digits of a year
_MAX_TIME = 1e12
_MAX_LENGTH = 40
_DIGITS = {8: "%Y%m%d", 12: "%Y%m%d%H%M", 14: "%Y%m%d%H%M%S"}
_AMERICAN = ("%m-%d-%Y", "%m-%d-%Y %H:%M", "%m-%d-%Y %H:%M:%S")
_AMERICAN += ("%m-%d-%Y %I:%M %p", "%m-%d-%Y %I:%M:%S %p")
_HHMM = re.compile(r"[0-9]{1,4}(\.0)?")
_CLOCK = re.compile(r"([0-9]{1,2}):([0-9]{2})(?::([0-9]{2}))?(?: ?(AM|PM))?")


def perimeter_times(frame: Any, wanted: str | None, unit: Units | None) -> tuple[np.ndarray, Clock]:
    """Reads the time of each feature.

    Args:
        frame: a table with a column per attribute; the index names the features in messages.
        wanted: `fire.time_field`; None takes the only column with a known name.
        unit: `fire.units`.

    Returns:
        The times, float64 [features], and their clock.

    Raises:
        UserError: no column, several columns, or a value that is not a time.
    """
    names = {str(name).lower(): str(name) for name in frame.columns if name != frame.geometry.name}
    known = ", ".join(list(names.values())[:30]) or "none"
    if wanted is not None:
        if wanted.lower() not in names:
            raise UserError(f"no column {wanted!r} (fire.time_field); there are {known}")
        if wanted.lower() == "date_" and "time_" in names:
            return _geomac(frame, names["date_"], names["time_"])
        return _of_column(frame[names[wanted.lower()]], unit)
    edited = known_columns(names, EDITED)
    columns = known_columns(names, tuple(ELAPSED)) or known_columns(names, CALENDAR) or edited
    if "time_" in names and names.get("date_") in columns:
        whole = [name for name in known_columns(names, _WHOLE) if frame[name].notna().any()]
        # The suggested column comes first. A date alone would lose the time of day.
        date = [] if whole else [names["date_"]]
        columns = [*whole, *date, *(name for name in columns if name.lower() in _DATES)]
        if columns == date:
            return _geomac(frame, names["date_"], names["time_"])
    if len(columns) > 1:
        raise UserError(
            f"the columns {', '.join(columns)} may hold the times; expected fire.time_field, such "
            f"as fire.time_field={columns[0]}"
        )
    if not columns:
        raise UserError(f"no column of times is known; expected fire.time_field, one of {known}")
    column = frame[columns[0]]
    for other in edited:
        column = column.where(column.notna(), frame[other])
    return _of_column(column, unit)


def parse_time(text: str) -> datetime:
    """Reads a calendar time. The result has a zone only if the text has one.

    Known forms are ISO 8601 (also with slashes), digits such as 20200819, 202008191300 and
    20200819130000, RFC 2822 (`Fri, 13 Feb 2026 14:30:58 GMT`), and month first with slashes as in
    the USA (`8/19/2015 1:55:00 AM`).

    Raises:
        UserError: the text has another form.
    """
    text = text.strip()
    if len(text) > _MAX_LENGTH:
        raise UserError(f"{text[:_MAX_LENGTH]!r} is not a calendar time")
    text = text.replace("/", "-")
    forms = _AMERICAN
    if text.isdecimal() and len(text) in _DIGITS:
        forms = (_DIGITS[len(text)],)
    else:
        try:
            return parsedate_to_datetime(text) if "," in text else datetime.fromisoformat(text)
        except (TypeError, ValueError, OverflowError):
            pass
    for form in forms:
        try:
            return datetime.strptime(text, form)
        except ValueError:
            continue
    raise UserError(f"{text!r} is not a calendar time")


def in_utc(time: datetime) -> datetime:
    """Returns the time in UTC. A time without a zone is taken as UTC.

    Raises:
        UserError: the time is before year 1 or after year 9999.
    """
    try:
        return time.astimezone(UTC) if time.tzinfo else time.replace(tzinfo=UTC)
    except OverflowError:
        raise UserError(f"{time.isoformat()} is before year 1 or after year 9999") from None


def known_columns(names: dict[str, str], known: Sequence[str]) -> list[str]:
    """Returns the columns with a known name, also in the short form of a .dbf.

    Args:
        names: the columns, by their names in lower case.
        known: in lower case.
    """
    short = {name[:_DBF_LENGTH] for name in known if len(name) > _DBF_LENGTH}
    return [names[name] for name in names if name in known or name in short]


def _of_column(column: Any, unit: Units | None) -> tuple[np.ndarray, Clock]:
    """Reads a column of elapsed times or of dates."""
    name = str(column.name)
    empty = np.flatnonzero(column.isna().to_numpy())
    if len(empty):
        raise UserError(f"{column.index[empty[0]]} has no time in {name}; expected one in each")
    values = column.tolist()
    numbers = [number for value in values if (number := _number(value)) is not None]
    elapsed = len(numbers) == len(values) and not all(map(_is_date, numbers))
    if elapsed or name.lower() in ELAPSED:
        return _elapsed(column, unit)
    dates = [_date(value, feature, name) for feature, value in column.items()]
    return _calendar(dates, name, column.index)


def _number(value: Any) -> float | None:
    try:
        return float(value)
    except (TypeError, ValueError):
        return None


def _is_date(number: float) -> bool:
    """Tells whether a number is a date in digits, or seconds or milliseconds since 1970."""
    digits = f"{number:.0f}"
    in_digits = len(digits) == 8 and digits[:2] in _CENTURIES
    return number >= _MIN_MS or _in_seconds(number) or in_digits


def _in_seconds(number: float) -> bool:
    """Tells whether a number is seconds since 1970."""
    return _MIN_S <= number < _MAX_S


def _date(value: Any, feature: str, name: str) -> datetime:
    """Reads a date as text, as a number in digits, or as seconds or milliseconds since 1970."""
    text, number = str(value), _number(value)
    try:
        if number is not None and _in_seconds(number):
            return datetime.fromtimestamp(number, UTC)
        if number is not None and _is_date(number):
            text = f"{number:.0f}"
            if len(text) not in _DIGITS or text[:2] not in _CENTURIES:
                return datetime.fromtimestamp(number / 1000, UTC)
        return parse_time(text)
    except (UserError, ValueError, OverflowError, OSError):
        raise UserError(
            f"{feature} has {name}={str(value)[:40]!r}, which is not a date; expected such as "
            "2020-08-19T13:00"
        ) from None


def _elapsed(column: Any, unit: Units | None) -> tuple[np.ndarray, Clock]:
    name = str(column.name)
    numbers: list[float] = []
    for feature, value in column.items():
        number = _number(value)
        if number is None or not 0 <= number <= _MAX_TIME:
            raise UserError(f"{feature} has {name}={str(value)[:40]}; expected a time of 0 or more")
        numbers.append(number)
    known = _unit_of(name)
    if known and unit and unit != known:
        raise UserError(f"{name} is in {known}; expected fire.units={known}, not {unit}")
    unit = known or unit
    if unit is None:
        raise UserError(
            f"the unit of {name} is not known; expected fire.units=minutes, seconds, hours, days "
            "or steps"
        )
    return np.array(numbers), Clock(unit)


def _unit_of(name: str) -> Units | None:
    """Returns the unit that the name of a column tells, also in the short form of a .dbf."""
    short: dict[str, Units] = {known[:_DBF_LENGTH]: unit for known, unit in ELAPSED.items()}
    return (ELAPSED | short).get(name.lower())


def _calendar(
    dates: Sequence[datetime], name: str, features: Sequence[str]
) -> tuple[np.ndarray, Clock]:
    """Returns minutes since the first date."""
    aware = [date.tzinfo is not None for date in dates]
    if any(aware) and not all(aware):
        raise UserError(
            f"{name}: {features[aware.index(True)]} has a time zone and "
            f"{features[aware.index(False)]} has none; expected all or none"
        )
    try:
        dates = [in_utc(date) for date in dates]
    except UserError as error:
        raise UserError(f"{name}: {error}") from None
    first = min(dates)
    values = [(date - first) / timedelta(minutes=1) for date in dates]
    return np.array(values), Clock("minutes", first)


def _geomac(frame: Any, date_name: str, time_name: str) -> tuple[np.ndarray, Clock]:
    """Joins GeoMAC's columns: a date, and the time of day."""
    dates: list[datetime] = []
    rows = zip(frame.index, frame[date_name], frame[time_name], strict=True)
    for feature, date, time in rows:
        try:
            day = parse_time(str(date)).replace(hour=0, minute=0, second=0)
            dates.append(day + _time_of_day(str(time)))
        except UserError:
            raise UserError(
                f"{feature} has {date_name}={str(date)[:40]}, {time_name}={str(time)[:40]}; "
                "expected a date and a time such as 2300, 23:00 or 11:00 PM"
            ) from None
    return _calendar(dates, f"{date_name}, {time_name}", frame.index)


def _time_of_day(text: str) -> timedelta:
    """Reads 2300, 155 or 155.0 (HHMM), 23:00, 1:55:00, or 11:55 PM."""
    text = text.strip().upper()
    if _HHMM.fullmatch(text):
        number = int(text.removesuffix(".0"))
        hour, minute, second, half = number // 100, number % 100, 0, None
    elif match := _CLOCK.fullmatch(text):
        hour, minute, second = (int(part or 0) for part in match.groups()[:3])
        half = match[4]
    else:
        raise UserError(f"{text[:40]!r} is not a time of day")
    if minute > 59 or second > 59 or not (1 <= hour <= 12 if half else hour <= 23):
        raise UserError(f"{text!r} is not a time of day")
    if half:
        hour = hour % 12 + (12 if half == "PM" else 0)
    return timedelta(hours=hour, minutes=minute, seconds=second)
