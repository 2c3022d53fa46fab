"""Finds the times of perimeters: elapsed or dates, in one column or more, or outside the table."""

import re
from collections.abc import Sequence
from datetime import UTC, datetime, time, timedelta
from typing import Any, NamedTuple

import numpy as np

from emberlink.envs.fire_files.areas import nested
from emberlink.envs.fire_files.config import Clock, FileFireConfig
from emberlink.envs.fire_files.dates import (
    at_midnight,
    date_within,
    in_utc,
    is_date,
    is_stamp,
    parse_dates,
    time_of_day,
)
from emberlink.envs.fire_files.features import column_named, plain, texts
from emberlink.envs.utils.errors import UserError

_UNITS = {
    "minutes": "elapsed_mi elapsed_min elapsed_minutes minutes",
    "seconds": "elapsed_s elapsed_sec elapsed_seconds seconds",
    "hours": "elapsed_h elapsed_hours hours",
    "days": "elapsed_days days",
}
_CALENDAR = (
    "poly_polygondatetime polygondatetime perimeterdatetime perdatetime perdattime gdb_from_date "
    "datetime date_time timestamp acq_datetime tutc valid_at acq_date date time t begin"
)
_EDITED = "poly_datecurrent datecurrent"
"""Columns of elapsed time; of the time when a perimeter was mapped; when a record was changed."""
_HOURS = r"(hours?|hora|heure|hr|h)"
_CLOCKS = rf"(.*)(time|{_HOURS}|uhr|hhmm|clock)(utc|gmt|z|local)?"
_MAX_TIME = 1e12


class Times(NamedTuple):
    """The time of each feature, in the unit of the clock, and where it was found."""

    values: np.ndarray
    clock: Clock
    column: str
    facts: list[str]
    doubts: list[str]


def read_times(frame: Any, config: FileFireConfig, outside: Sequence[str]) -> Times:
    """Reads the time of each feature.

    Args:
        frame: a table with a column per attribute; the index names the features in messages.
        outside: columns whose values stand outside the attributes.
    """
    columns = [name for name in frame.columns if name != frame.geometry.name]
    given = config.time_field
    if given is None:
        chosen = _candidates(frame, [name for name in columns if name not in outside])
    else:
        names = [given] if isinstance(given, str) else given
        chosen = [column_named(name, columns, "fire.time_field") for name in names]
    if not chosen or (chosen[0] in outside and not _holds_dates(frame[chosen[0]])):
        return _outside(frame, chosen or outside, config)
    first = chosen[0]
    empty = frame.index[frame[chosen].isna().any(axis=1)]
    if len(empty):
        raise UserError(
            f"{empty[0]} has no time in {first} ({len(empty)} of {len(frame)}); expected one in "
            f"each, or fire.where={first} to leave out those without"
        )
    numbers: list[Any] = [_number(value) for value in frame[first].unique()]
    if len(chosen) == 1 and None not in numbers and not is_stamp(numbers):
        return _elapsed(frame, first, config)
    dates = _dates(frame[first], config.time_format)
    if len(chosen) == 1 and all(map(at_midnight, dates)):
        chosen += _clocks_beside(frame, first, columns, asked=given is None)
    for name in chosen[1:]:
        shifts = _clock(frame, first, name)
        days = (datetime.combine(d, time(d.hour, tzinfo=d.tzinfo)) for d in dates)
        dates = [day + shift for day, shift in zip(days, shifts, strict=True)]
    return _calendar(frame, dates, " and ".join(map(str, chosen)))


def _known(names: str) -> set[str]:
    """Returns the plain forms of names, also of those cut to ten letters, as in a .dbf."""
    return {plain(part) for name in names.split() for part in (name, name[:10])}


def _candidates(frame: Any, columns: Sequence[Any]) -> list[Any]:
    """Returns the column with a known name; asks if several are left."""
    if "Folder" in frame and "TimeStamp" in columns and frame["TimeStamp"].notna().all():
        return ["TimeStamp"]  # of KML
    names = {plain(name): name for name in columns if frame[name].notna().any()}
    dated = [n for short, n in names.items() if short in _known(_CALENDAR)]
    elapsed = [n for short, n in names.items() if short in _known(" ".join(_UNITS.values()))]
    if any(_holds_dates(frame[name]) for name in dated):
        elapsed = [name for name in elapsed if plain(name).startswith("elapsed")]
    dated = [name for name in dated if _holds_dates(frame[name])] or dated
    dated = [name for name in dated if not _date_only(frame[name])] or dated
    edited = [n for short, n in names.items() if short in _known(_EDITED)]
    found = elapsed or dated or edited
    if len(found) > 1:
        listed = ", ".join(map(str, found))
        raise UserError(
            f"the columns {listed} may hold the times; expected fire.time_field={found[0]} or such"
        )
    return found


def _number(value: Any) -> float | None:
    try:
        return float(value)
    except (TypeError, ValueError):
        return None


def _holds_dates(column: Any) -> bool:
    values = column.dropna().unique()
    numbers: list[Any] = [_number(value) for value in values]
    return is_stamp(numbers) if None not in numbers else is_date(str(values[0]))


def _date_only(column: Any) -> bool:
    try:
        return all(map(at_midnight, _dates(column.dropna(), None)))
    except UserError:
        return False


def _dates(column: Any, form: str | None) -> list[datetime]:
    """Returns a date for each feature; the distinct texts are read."""
    values = texts(column).map(lambda text: f"{float(text):.0f}" if "e+" in text else text)
    distinct = list(values.unique())
    try:
        read = dict(zip(distinct, parse_dates(distinct, form, str(column.name)), strict=True))
    except UserError as error:
        place = next((f"{i}: " for i, text in values.items() if repr(text[:40]) in str(error)), "")
        raise UserError(f"{place}{error}") from None
    return [read[text] for text in values]


def _clocks_beside(frame: Any, date: Any, columns: Sequence[Any], *, asked: bool) -> list[Any]:
    """Returns the columns of times of day that belong to a column of dates; asks if unsure."""
    found = {}
    for name in columns:
        match = re.fullmatch(_CLOCKS, plain(name))
        if match and name != date and any(map(_is_clock, frame[name].dropna().unique())):
            found[name] = match
    stem = re.sub(r"(date|day|datum|fecha|data)", "", plain(date))
    paired = [name for name, match in found.items() if match[1] == stem]
    if len(paired) == 1:
        minutes = [name for name in columns if re.fullmatch(r"min(ute)?s?", plain(name))]
        return paired + (minutes if re.fullmatch(_HOURS, plain(paired[0])) else [])
    if found and asked:
        some = next(iter(found))
        raise UserError(
            f"{date} holds dates without a time of day, which {', '.join(map(str, found))} may "
            f"hold; expected 'fire.time_field=[{date},{some}]' to join them, or "
            f"fire.time_field={date}"
        )
    return []


def _is_clock(value: Any) -> bool:
    try:
        return bool(time_of_day(value) + timedelta(1))
    except ValueError:
        return False


def _clock(frame: Any, date: Any, name: Any) -> list[timedelta]:
    """Reads a column of times of day: HHMM, HH:MM, with AM or PM, or hours, or minutes."""
    minutes = re.fullmatch(r".*min(ute)?s?", plain(name))
    hours = bool(re.fullmatch(rf".*{_HOURS}(utc|gmt|z|local)?", plain(name)))
    read = {}
    for feature, value in frame[name].drop_duplicates().items():
        try:
            read[value] = (
                timedelta(minutes=int(value)) if minutes else time_of_day(value, hours=hours)
            )
        except ValueError:
            raise UserError(
                f"{feature} has {date}={str(frame[date][feature])[:40]}, {name}={str(value)[:40]}; "
                "expected a date and a time such as 2300, 23:00 or 11:00 PM"
            ) from None
    return [read[value] for value in frame[name]]


def _calendar(frame: Any, dates: Sequence[datetime], name: str) -> Times:
    """Returns minutes since the first date."""
    aware = [date.tzinfo is not None for date in dates]
    if any(aware) and not all(aware):
        some, other = frame.index[aware.index(True)], frame.index[aware.index(False)]
        raise UserError(f"{name}: {some} has a time zone and {other} has none; expected one in all")
    try:
        moments = {date: in_utc(date) for date in {*dates}}
    except OverflowError:
        raise UserError(f"{name}: a date before year 1 or after year 9999") from None
    first, last = min(moments.values()), max(moments.values())
    values = np.array([(moments[date] - first) / timedelta(minutes=1) for date in dates])
    zone = "zone of the file" if all(aware) else "no zone in the file, read as UTC"
    doubts = []
    if last > datetime.now(UTC) + timedelta(days=1):
        doubts.append(f"{last:%Y-%m-%d} is in the future")
    days = np.unique(values) if all(map(at_midnight, dates)) else ()
    within = sum(nested(frame.geometry[values == day].tolist()) for day in days)
    if within:
        doubts.append(
            f"{len(frame)} features have {len(days)} dates in {name} without a time of day, and "
            f"perimeters of one date lie in one another ({within} dates): their order is lost, "
            "each date is read as one time"
        )
    return Times(values, Clock("minutes", first), name, [f"times from {name}, {zone}"], doubts)


def _elapsed(frame: Any, name: Any, config: FileFireConfig) -> Times:
    values = frame[name].astype(float).to_numpy()
    wrong = np.flatnonzero(~((values >= 0) & (values <= _MAX_TIME)))
    if len(wrong):
        value = f"{frame.index[wrong[0]]} has {name}={values[wrong[0]]:g}"
        raise UserError(f"{value}; expected a time of 0 or more")
    known = next((unit for unit, names in _UNITS.items() if plain(name) in _known(names)), None)
    unit = config.units or known
    if known and unit != known:
        raise UserError(f"{name} is in {known}; expected fire.units={known}, not {unit}")
    if unit is None:
        raise UserError(
            f"the unit of {name} ({values.min():g} to {values.max():g}) is not known; expected "
            "fire.units=minutes, seconds, hours, days, day_of_year or steps"
        )
    if unit in ("days", "day_of_year"):
        values, unit = in_order(values, config), "days"
    return Times(values, Clock(unit), str(name), [f"times from {name}"], [])


def in_order(values: np.ndarray, config: FileFireConfig) -> np.ndarray:
    """Returns days, days of the year continued over New Year; asks if unsure."""
    days = np.unique(values[np.isfinite(values)])
    gaps = np.diff(days, append=days[0] + (366 if days[-1] > 365 else 365))
    last = int(gaps.argmax())
    first = days[(last + 1) % len(days)]
    if config.units == "day_of_year":
        return np.where(values < first, values + gaps.sum(), values)
    cyclic = days[0] >= 1 and days[-1] <= 366 and (days % 1 == 0).all()
    if config.start is None and cyclic and last < len(days) - 1 and gaps[last] > 183:
        raise UserError(
            f"days {days[0]:g} to {days[last]:g} and {first:g} to {days[-1]:g}, none between, as "
            "of a fire over New Year; expected fire.units=day_of_year, or "
            f"fire.start={days[0]:g} for days as they are"
        )
    return values


def _outside(frame: Any, outside: Sequence[str], config: FileFireConfig) -> Times:
    """Reads the dates in names of placemarks, folders and files, or beside the features."""
    found = {}
    for name in outside:
        written = [date_within(str(value)) for value in frame[name]] if name in frame else [""]
        if all(written):
            found[name] = parse_dates(written, config.time_format, name)
    first = next(iter(found), "")
    if any(dates != found[first] for dates in found.values()):
        listed = " and in ".join(found)
        raise UserError(f"dates in {listed} differ; expected fire.time_field={first} or such")
    if found:
        return _calendar(frame, found[first], first)
    columns = [name for name in frame.columns if name != frame.geometry.name]
    dated = [n for n in columns if frame[n].notna().any() and _holds_dates(frame[n])]
    seen = [f"{name} ({str(frame[name].iloc[0])[:30]})" for name in (dated or columns)[:15]]
    listed = ", ".join(seen) or "none"
    raise UserError(f"no column of times is known; expected fire.time_field, one of {listed}")
