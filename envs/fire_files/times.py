"""Finds the times of features: elapsed or dates, in one column or more, or outside the table."""

import re
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from typing import Any, NamedTuple

import numpy as np

from emberlink.envs.fire_files.config import Clock, FileFireConfig
from emberlink.envs.fire_files.dates import (
    date_within,
    has_clock,
    in_utc,
    is_date,
    parse_dates,
    time_of_day,
)
from emberlink.envs.fire_files.features import column_named, plain, texts
from emberlink.envs.fire_files.files import library
from emberlink.envs.utils.errors import UserError

_ELAPSED = {
    "minutes": "elapsed_mi elapsed_min elapsed_minutes minutes",
    "seconds": "elapsed_s elapsed_sec elapsed_seconds seconds",
    "hours": "elapsed_h elapsed_hours hours",
    "days": "elapsed_days days",
}
_MAPPED = (
    "poly_polygondatetime polygondatetime perimeterdatetime perdatetime perdattime gdb_from_date "
    "datetime date_time timestamp acq_datetime tutc valid_at acq_date date time t begin"
)
_EDITED = "poly_datecurrent datecurrent"
"""Columns of elapsed time; of the time when a perimeter was mapped; when a record was changed."""
_HOUR, _MINUTE = r"(hours?|hora|heure|hr|h)", r"min(ute)?s?"
_OF_DAY = rf"(.*)(time|{_HOUR}|uhr|hhmm|clock|ampm)(utc|gmt|z|local)?"
_HALF = re.compile(r"\s*[ap]\.?m\.?\s*", re.IGNORECASE)
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
        chosen = _candidates(frame, [name for name in columns if name not in outside], config)
    else:
        given = (given,) if isinstance(given, str) else given
        chosen = [column_named(name, columns, "fire.time_field") for name in given]
    names = (*outside, "Description")
    if not chosen or (chosen[0] in names and not _holds_dates(frame[chosen[0]])):
        return _outside(frame, chosen or outside, config)
    empty = frame.index[frame[chosen].isna().any(axis=1)]
    if len(empty):
        raise UserError(
            f"{empty[0]} has no time in {chosen[0]} ({len(empty)} of {len(frame)}); expected one "
            f"in each, or fire.where={chosen[0]} to leave out those without"
        )
    dates = texts(frame[chosen[0]])
    if len(chosen) == 1 and _is_elapsed(dates, config):
        return _elapsed(frame, chosen[0], config)
    read = _dates(dates, config.time_format)
    if len(chosen) == 1 and not has_clock(read):
        chosen += _clocks_beside(frame, chosen[0], columns, asked=given is None)
    if len(chosen) > 1:
        read = [day + shift for day, shift in zip(read, _clocks(frame, chosen), strict=True)]
    return _calendar(frame, read, " and ".join(map(str, chosen)))


def _known(names: str) -> set[str]:
    """Returns the plain forms of names, also of those cut to ten letters, as in a .dbf."""
    return {plain(part) for name in names.split() for part in (name, name[:10])}


def _candidates(frame: Any, columns: Sequence[Any], config: FileFireConfig) -> list[Any]:
    """Returns the column with a known name; asks if several are left."""
    if "Folder" in frame and "TimeStamp" in columns and frame["TimeStamp"].notna().all():
        return ["TimeStamp"]  # of KML
    elapsed, mapped, edited = (
        [n for n in columns if plain(n) in _known(names) and frame[n].notna().any()]
        for names in (" ".join(_ELAPSED.values()), _MAPPED, _EDITED)
    )
    dated = [name for name in mapped if _holds_dates(frame[name])]
    timed = [
        name for name in dated if has_clock(_dates(texts(frame[name].dropna()), config.time_format))
    ]
    elapsed = [name for name in elapsed if not dated or plain(name).startswith("elapsed")]
    found = elapsed or timed or dated or mapped or edited
    if len(found) > 1:
        listed = ", ".join(map(str, found))
        raise UserError(
            f"the columns {listed} may hold the times; expected fire.time_field={found[0]} or such"
        )
    return found


def _holds_dates(column: Any) -> bool:
    values = texts(column.dropna())
    return len(values) > 0 and is_date(values.iloc[0])


def _is_elapsed(values: Any, config: FileFireConfig) -> bool:
    """Returns whether all texts are numbers, and not dates in digits."""
    numbers = library("pandas").to_numeric(values, errors="coerce")
    dates = config.time_format is not None or all(map(is_date, values.unique()))
    return bool(numbers.notna().all()) and not dates


def _dates(values: Any, form: str | None) -> list[datetime]:
    """Returns a date for each text; each distinct one is read once."""
    distinct = list(values.unique())
    try:
        read = dict(zip(distinct, parse_dates(distinct, form, str(values.name)), strict=True))
    except UserError as error:
        place = next((f"{i}: " for i, text in values.items() if repr(text[:40]) in str(error)), "")
        raise UserError(f"{place}{error}") from None
    return [read[text] for text in values]


def _clocks_beside(frame: Any, date: Any, columns: Sequence[Any], *, asked: bool) -> list[Any]:
    """Returns the columns of times of day that belong to a column of dates; asks if unsure."""
    found, halves = {}, []
    for name in columns:
        values = texts(frame[name].dropna()).unique()
        match = re.fullmatch(_OF_DAY, plain(name))
        if len(values) and all(map(_HALF.fullmatch, values)):
            halves.append(name)
        elif name != date and match and any(time_of_day(text) is not None for text in values):
            found[name] = match[1]
    stem = re.sub(r"(date|day|datum|fecha|data)", "", plain(date))
    paired = [name for name, rest in found.items() if rest == stem]
    if len(paired) == 1:
        minutes = [name for name in columns if re.fullmatch(_MINUTE, plain(name))]
        return [*paired, *(minutes if re.fullmatch(_HOUR, plain(paired[0])) else []), *halves]
    if (found or halves) and asked:
        names = [*found, *halves]
        raise UserError(
            f"{date} holds dates without a time of day, which {', '.join(map(str, names))} may "
            f"hold; expected 'fire.time_field=[{date},{names[0]}]' to join them, or "
            f"fire.time_field={date}"
        )
    return []


def _clocks(frame: Any, chosen: Sequence[Any]) -> list[timedelta]:
    """Reads the times of day in columns of hours, minutes, HHMM, HH:MM, and AM or PM."""
    _, first, *others = chosen
    joined = texts(frame[first])
    for name in others:
        minutes = re.fullmatch(rf".*{_MINUTE}", plain(name))
        joined += texts(frame[name]).map(":{:>02}".format if minutes else " {}".format)
    if re.fullmatch(rf".*{_HOUR}(utc|gmt|z|local)?", plain(first)):
        joined = joined.str.replace(r"^(\d\d?)(?=$| )", r"\1:00", regex=True)
    read = {text: time_of_day(text) for text in joined.unique()}
    for feature, text in joined.items():
        if read[text] is None:
            seen = ", ".join(f"{name}={str(frame[name][feature])[:40]}" for name in chosen)
            raise UserError(
                f"{feature} has {seen}; expected a date and a time such as 2300, 23:00 or 11:00 PM"
            )
    return [read[text] or timedelta(0) for text in joined]


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
    days = np.unique(values) if not has_clock(dates) else ()
    within = sum(_nested(frame.geometry[values == day]) for day in days)
    if within:
        doubts.append(
            f"{len(frame)} features have {len(days)} dates in {name} without a time of day, and "
            f"perimeters of one date lie in one another ({within} dates): their order is lost, "
            "each date is read as one time"
        )
    return Times(values, Clock("minutes", first), name, [f"times from {name}, {zone}"], doubts)


def _nested(shapes: Any) -> bool:
    """Returns whether one of some shapes lies in another that is larger by a tenth or more."""
    areas = shapes.convex_hull
    inner, outer = areas.sindex.query(areas, predicate="covered_by")
    sizes = areas.area.to_numpy()
    return bool((sizes[inner] < 0.9 * sizes[outer]).any())


def _elapsed(frame: Any, name: Any, config: FileFireConfig) -> Times:
    """Returns elapsed times, in the unit of the column's name or of `fire.units`."""
    values = texts(frame[name]).astype(float).to_numpy()
    wrong = np.flatnonzero(~((values >= 0) & (values <= _MAX_TIME)))
    if len(wrong):
        value = f"{frame.index[wrong[0]]} has {name}={values[wrong[0]]:g}"
        raise UserError(f"{value}; expected a time of 0 or more")
    known = next((unit for unit, names in _ELAPSED.items() if plain(name) in _known(names)), None)
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
    columns = [name for name in frame.columns if name not in (*outside, frame.geometry.name)]
    columns = [name for name in columns if _holds_dates(frame[name])] or columns
    seen = [f"{name} ({str(frame[name].iloc[0])[:30]})" for name in columns[:15]]
    if not seen:
        raise UserError("no attribute or name holds times; expected perimeters with times")
    raise UserError(
        f"no column of times is known, of {', '.join(seen)}; expected the one in fire.time_field, "
        f"such as fire.time_field={columns[0]}"
    )
