"""Finds the times of features, elapsed or dates, by strict patterns; asks if several fit."""

import functools
import re
from collections.abc import Sequence
from contextlib import suppress
from datetime import UTC, datetime, time, timedelta
from typing import Any

import numpy as np

from emberlink.envs.fire_files.config import FileFireConfig
from emberlink.envs.fire_files.report import SECONDS, Clock, Report, ask
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import as_argument

_OUTSIDE = ("Name", "Folder", "File")  # of KML and of a folder: beside the attributes, with dates
FOLDERS = " > "  # between the names of folders of KML, one within the other
_MAPPED = (
    r"(poly)?polygond\w*|polypolyg|perimeterd\w*|perdat\w*|gdbfromdat\w*|datetime|timestamp|tutc"
    r"|acqdat\w*|validat|date|fecha|datum|time|t|begin|elapsed\w*|seconds|minutes|hours|days"
)
"""Columns of times by the letters and digits of their names, also cut to ten, as in a .dbf."""
_HOUR = r"(.*(hours?|hrs?)|(hora|heure|uhr)\w*|h)(utc|gmt|z|local)?"
_MINUTE = r"min(ut\w*)?s?"
_OF_DAY = rf"{_HOUR}|{_MINUTE}|.*(time(utc|gmt|z|local)?|hhmm|clock|ampm|zeit)"
_UNITS = {
    "seconds": r"s|secs?|seconds?",
    "minutes": r"mins?|minutes?",
    "hours": r"h|hrs?|hours?",
    "days": r"d|days?",
    "day_of_year": r"days? of (the )?year|doy|julian days?",
    "steps": r"steps?|time ?steps?",
    "no unit of time": r"m|ft|feet|foot|met(er|re)s?|deg(ree)?s?|%|percent|.+/.+",
}
_DAYS = ("%Y-%m-%d", "%Y-%j", "%d-%b-%Y", "%d-%b-%y", "%b-%d-%Y", "%Y%m%d")
"""Patterns of days; - is any separator."""
_ORDERS = {
    "day_first": ("%d-%m-%Y", "%d-%m-%y"),
    "month_first": ("%m-%d-%Y", "%m-%d-%y"),
    "year_first": ("%y-%m-%d",),
}
"""More patterns, by the `fire.time_format` that each needs."""
_SINCE_1970 = {"seconds": 1, "milliseconds": 1000}
_DIGITS = {
    0: tuple(_ORDERS),
    8: ("%Y%m%d",),
    10: ("seconds", "%y%m%d%H%M", "%Y%m%d%H"),
    12: ("%Y%m%d%H%M",),
    13: ("milliseconds",),
    14: ("%Y%m%d%H%M%S",),
}
"""Patterns of texts of digits, by their length; 0 for other texts."""
_ZONES = """Z+0000 UTC+0000 GMT+0000 UT+0000 WET+0000 BST+0100 CET+0100 CEST+0200 EET+0200 EEST+0300
AWST+0800 ACST+0930 AEST+1000 ACDT+1030 AEDT+1100 NZST+1200 NZDT+1300 HST-1000 AKST-0900 AKDT-0800
PST-0800 PDT-0700 MST-0700 MDT-0600 CST-0600 CDT-0500 EST-0500 EDT-0400"""
_OFFSETS = dict(re.findall(r"(\w+)([+-]\d+)", _ZONES))
_ZONE = "|".join([*sorted(_OFFSETS, key=len)[::-1], "local|(?-i:L|(?!HEAT|SPOT)[A-Z]{1,3}T)"])
"""Zones, and what may be one that is not known, so that its time is refused."""
_MONTH = r"(?:jan|feb|mar|apr|may|jun|jul|aug|sep|oct|nov|dec)[a-z]*\.?"
_DATE = re.compile(
    r"(?<!\d)(?:(?:mon|tue|wed|thu|fri|sat|sun)[a-z]*[,.]?\s*)?(?P<day>(?:19|20)\d{6}"
    r"|(?:19|20)\d\d([-/. ])\d\d?\2\d\d?|\d{4}-?\d{3}|\d\d?([-/.])\d\d?\3(?:\d{4}|\d\d)"
    rf"|\d\d?(?:st|nd|rd|th)?[-\s]?{_MONTH}[-,\s]*(?:\d{{4}}|\d\d)"
    rf"|{_MONTH}[-\s]+\d\d?(?:st|nd|rd|th)?,?\s+\d{{4}})"
    r"(?:(?:T|,?[\s-]+(?:(?:at|@)\s*)?|(?<=\d{8})(?=\d{4}))(?P<hour>\d\d?|(?=[ap]\.?m\b))"
    r"(?=[:h]?\d\d|\s?[ap]\.?m)(?:[:h]?(?P<minute>\d\d))?(?::?(?P<second>\d\d)(?:[.,]\d+)?)?"
    rf"(?:\s?(?P<half>[ap])\.?m\.?)?(?:\s?(?:h(?:ou)?rs?|uhr)\b)?(?:\s?\(?(?P<zone>{_ZONE})\b\)?)?"
    r"(?:\s?(?P<sign>[+-])(?P<hours>[01]?\d)(?::?(?P<minutes>\d\d))?(?:\s?\([^)]*\))?)?)?(?!\d)",
    re.IGNORECASE,
)
"""A day, with or without a time of day, or a half of the day, and its zone."""
_APART = r"((?:19|20)\d\d[- ]?\d\d[- ]?\d\d[T -]\d\d)((?:[-.h ]\d\d){1,2})(?!\d)"


def plain(name: Any) -> str:
    """Returns the letters and digits of a column's name, in lower case."""
    return re.sub(r"[\W_]", "", str(name).lower())


def names_unit(name: Any) -> bool:
    """Returns whether a column or a tag holds the unit of times, by its name."""
    return re.fullmatch("(time)?units?", plain(name)) is not None


def column_named(name: str, table: Any, key: str) -> Any:
    """Returns the column with a name in any case."""
    columns = {str(column).lower(): column for column in table}
    if (wanted := name.strip().lower()) not in columns:
        known = ", ".join(map(str, [*table][:30])) or "none"
        raise UserError(f"no column {name.strip()!r} ({key}); there are {known}")
    return columns[wanted]


def read_times(
    table: Any, shapes: Any, config: FileFireConfig, report: Report
) -> tuple[np.ndarray, Clock]:
    """Returns the time of each feature, and their clock."""
    if "%" not in (config.time_format or ""):  # of names and descriptions, only the date in them
        loose = table.columns.intersection([*_OUTSIDE, "Description"])
        table = table.assign(**{name: table[name].map(date_within) for name in loose})
    names, form = _columns(table, config.time_field), config.time_format
    _refuse_empty(table, names, config)
    texts = table[names[0]]
    if len(names) == 1 and form is None and not all(map(is_date, texts.unique())):
        numbers = texts.str.extract(r"^(\d+(?:\.\d*)?(?:e[-+]?\d+)?)$", expand=False).astype(float)
        if numbers.notna().all():
            return _elapsed(numbers.to_numpy(), names[0], table, config, report)
    if config.time_field is None:
        dates = parse_dates(texts, form, names[0], table.index)
        names += [] if _has_clock(dates) else _clocks_beside(table, names[0])
        if all(date.tzinfo is None for date in dates) and (_has_clock(dates) or names[1:]):
            zones = [name for name in table if re.fullmatch("(time)?zone|tz", plain(name))]
            names += [name for name in zones if all(table[name])]
        _refuse_empty(table, names, config)
    title = " and ".join(map(str, names))
    if len(names) > 1 and "%" not in (form or ""):
        with suppress(UserError):  # such as a year, without its month
            dates = parse_dates(texts, form, title)
            if not _has_clock(dates):  # midnight, also of another zone
                days = [f"{date:%Y-%m-%d}" for date in dates]
                table, form = table.assign(**{names[0]: days}), None
    dates = parse_dates(_joined(table, names), form, title, table.index)
    naive = {date.tzinfo is None for date in dates}
    if len(naive) > 1:
        raise ask(f"{title}: some times have a zone and others have none", "one in all")
    zone = "no zone in the file, read as UTC" if True in naive else "zone of the file"
    report.facts.append(f"times from {title}, {zone}")
    moments = [in_utc(date) for date in dates]
    first, last = min(moments), max(moments)
    values = np.array([(moment - first) / timedelta(minutes=1) for moment in moments])
    report.doubts += [f"{first:%Y-%m-%d} is long ago"] * (first.year < 1950)
    future = last > datetime.now(UTC) + timedelta(days=1)
    report.doubts += [f"{last:%Y-%m-%d} is in the future"] * future
    bare = np.array([date.time() == time() for date in dates]) | (not _has_clock(dates))
    days = np.unique(values[bare])
    if within := sum(_nested(shapes[values == day]) for day in days):
        report.doubts.append(
            f"{bare.sum()} features have {len(days)} dates in {title} without a time of day, and "
            f"perimeters of one date lie in one another ({within} dates): their order is lost"
        )
    return values, Clock("minutes", first)


def _refuse_empty(table: Any, names: Sequence[Any], config: FileFireConfig) -> None:
    for name in names:
        if len(empty := table.index[table[name] == ""]):
            if len(empty) == len(table):
                raise ask(f"no date is found in {name}", "its pattern in fire.time_format")
            key = as_argument("fire.where", *config.conditions, name)
            seen = f"{empty[0]} has no time in {name} ({len(empty)} of {len(table)})"
            raise ask(seen, "one in each", f"{key} to leave out those without")


def _elapsed(
    values: np.ndarray, name: str, table: Any, config: FileFireConfig, report: Report
) -> tuple[np.ndarray, Clock]:
    about = f"{name} ({values.min():.10g} to {values.max():.10g})"
    form = r"elapsed{0:.2}\w*|(arrival)?(time|toa|t)(in)?{0:.3}\w*|{0}"
    told = {u for u in SECONDS if re.fullmatch(form.format(u), plain(name))}
    told = told or {text for column in table if names_unit(column) for text in table[column]}
    dates = "the pattern of dates in fire.time_format"
    unit = decided_unit(told.pop() if len(told) == 1 else "", config, about, report, dates)
    report.facts.append(f"times from {name}")
    return in_order(values, unit, config)


def _columns(table: Any, given: str | Sequence[str] | None) -> list[Any]:
    """Returns the columns of `fire.time_field`, or the column with a known name; asks if unsure."""
    if given is not None:
        given = (given,) if isinstance(given, str) else given
        return [column_named(name, table, "fire.time_field") for name in given]
    filled = [name for name in table if (table[name] != "").any()]
    known = [name for name in filled if re.fullmatch(_MAPPED, plain(name))]
    dated = [name for name in filled if is_date(next(filter(None, table[name])))]
    found = [name for name in known if name in dated] or known
    found = found or [name for name in filled if name in _OUTSIDE and all(table[name])]
    if not found or table[found].ne(table[found[0]], axis=0).any(axis=None):
        maybe = found or [*dated, *(name for name in filled if name not in dated)]
        maybe = sorted(maybe, key=lambda name: table[name].nunique() == 1)[:15]
        seen = ", ".join(f"{name} ({table[name].iloc[0][:30]})" for name in maybe)
        parts = [n for part in ("year", "month", "day") for n in filled if plain(n) == part]
        fields = parts if len(parts) == 3 else maybe[:1] or ["COLUMN"]
        if fields == parts or (fields[0] in dated and ":" not in table[fields[0]].iloc[0]):
            fields += _clocks(table.drop(columns=fields))
        key = as_argument("fire.time_field", *fields)
        undated = [name for name in _OUTSIDE if name in table and name not in filled]
        keys = [f"fire.time_field={name} with its pattern in fire.time_format" for name in undated]
        keys.insert(len(keys) * (fields[0] not in dated), f"{key} or such")
        raise ask(f"which column holds the times: {seen or 'none'}?", *keys)
    return found[:1]


def _clocks_beside(table: Any, date: Any) -> list[Any]:
    """Returns the column of times of day if its name says that it belongs to the dates, or asks."""
    names = _clocks(table.drop(columns=date))
    if names and (len(names) > 1 or plain(date).replace("date", "time") != plain(names[0])):
        key = f"{as_argument('fire.time_field', date, *names)} to join them"
        seen = f"{date} has no times of day, maybe {', '.join(names)} has"
        raise ask(seen, key, as_argument("fire.time_field", date))
    for name in table.columns.drop([date, *names]):  # a full stamp named as a time of day
        more = table[name].nunique() > table[date].nunique()
        if more and re.fullmatch(_OF_DAY, plain(name)) and all(map(is_date, table[name])):
            fields = (as_argument("fire.time_field", column) for column in (name, date))
            raise ask(f"{date} has no times of day, and {name} holds dates, too", *fields)
    return names


def _clocks(table: Any) -> list[Any]:
    """Returns the columns that may hold times of day, by their names or by all of their values."""
    names = []
    for name in table:
        values = table[name][table[name] != ""]
        if len(values) == 0 or is_date(values.iloc[0]):
            continue
        named = re.fullmatch(_OF_DAY, plain(name)) and values.str.match(r"\d{1,6}(?i:z|h|\b)").any()
        all_are = values.str.match(r"(?i)\d\d?[:h]\d\d|[ap]\.?m\b").all()
        names += [name] if named or all_are else []
    return names


def _joined(table: Any, names: Sequence[Any]) -> Any:
    """Joins dates with times of day in columns of hours, minutes, HHMM, HH:MM, and AM or PM."""
    joined = table[names[0]]
    for name in names[1:]:
        part, title = table[name], plain(name)
        if re.fullmatch(_MINUTE, title):
            joined = joined.str.removesuffix(":00") + ":" + part.str.zfill(2)
            continue
        if re.fullmatch(_HOUR, title):
            part = part.str.replace(r"^(\d\d?)$", r"\1:00", regex=True)
        if title not in ("month", "day"):
            part = part.str.replace(r"^\d{1,3}$", lambda few: few[0].zfill(4), regex=True)
        joined += " " + part.str.replace(r"(?i)^([ap]\.?m)\b.*", r"\1", regex=True)  # AM flight
    return joined


def _nested(shapes: Any) -> bool:
    """Returns whether one of some shapes lies in another that is larger by a tenth or more."""
    areas = shapes.convex_hull
    inner, outer = areas.sindex.query(areas, predicate="covered_by")
    sizes = areas.area.to_numpy()
    return bool((sizes[inner] < 0.9 * sizes[outer]).any())


def decided_unit(
    declared: str, config: FileFireConfig, what: str, report: Report, *others: str
) -> str:
    """Returns the unit of the file or of the key; asks if there is none or they differ."""
    form = r"({})[.]?( *[(].*| (since|after|from) .*)?"
    units = (u for u in _UNITS if re.fullmatch(form.format(_UNITS[u]), declared, re.IGNORECASE))
    if (known := next(units, None)) == "no unit of time":
        raise ask(f"{what} is in {declared[:20]}, {known}", "arrival times")
    unit = config.units or known
    if declared and known is None and unit is not None:
        report.doubts.append(f"{what} is in {declared[:20]!r}, read as {unit}")
    if unit is None:
        some = "fire.units=minutes (FARSITE, FlamMap), seconds (ELMFIRE, WRF-SFIRE) or such"
        raise ask(f"the unit of {what} is not known", some, *others)
    if known not in (None, unit) and {known, unit} != {"days", "day_of_year"}:
        raise ask(f"{what} is in {known}", f"fire.units={known}, not {unit}")
    return unit


def in_order(
    values: np.ndarray, unit: str, config: FileFireConfig, origin: datetime | None = None
) -> tuple[np.ndarray, Clock]:
    """Returns times with their clock, days of the year continued over New Year; asks if unsure."""
    if unit in ("days", "day_of_year"):
        days = np.unique(values[np.isfinite(values)])
        gaps = np.diff(days, append=days[0] + (366 if days[-1] > 365 else 365))
        last = int(gaps.argmax())
        first = days[(last + 1) % len(days)]
        cyclic = days[0] >= 1 and days[-1] <= 366 and (days % 1 == 0).all()
        if unit == "day_of_year":
            if days[-1] > 366:
                raise ask(f"{days[-1]:.9g} is no day of the year", "1 to 366")
            values = np.where(values < first, values + gaps.sum(), values)
        elif config.start is None and cyclic and last < len(days) - 1 and gaps[last] > 183:
            seen = f"days {days[0]:g} to {days[last]:g} and {first:g} to {days[-1]:g}"
            start = f"fire.start={days[0]:g} for days as they are"
            raise ask(f"{seen}, over New Year?", "fire.units=day_of_year", start)
    return values, Clock(unit, origin)


def parse_dates(texts: Sequence[str], form: str | None, key: str, rows: Any = ()) -> list[datetime]:
    """Reads calendar times in one format: `form`, which is `fire.time_format`, or the only fit."""
    distinct = [*dict.fromkeys(texts)]
    fits = _fits(distinct, form)
    if not fits:
        wrong = next((text for text in distinct if not _fits([text], form)), distinct[0])
        place = dict(zip(texts, map("{}: ".format, rows), strict=False)).get(wrong, "")
        raise ask(f"{place}{key}={wrong[:40]!r} is not a date", "its pattern in fire.time_format")
    if len({tuple(map(in_utc, dates)) for dates in fits.values()}) > 1:
        listed = " or ".join(f"{name} ({read[0]:%Y-%m-%d %H:%M})" for name, read in fits.items())
        keys = map("fire.time_format={}".format, fits)
        raise ask(f"{key}={distinct[0][:40]!r} fits {listed}", *keys)
    read = dict(zip(distinct, next(iter(fits.values())), strict=True))
    return [read[text] for text in texts]


def _fits(texts: Sequence[str], form: str | None) -> dict[str, list[datetime]]:
    """Reads texts by the pattern `form`, or by each that may fit them all, by their digits."""
    wholes = (re.sub(r"[.]\d+$", "", text) for text in texts)
    lengths = {len(whole) if whole.isdecimal() else 0 for whole in wholes}
    fits, whole = {}, {8, 12, 14}  # digits of a day, with or without a time of day
    length = lengths.pop() if len(lengths) == 1 else 0 if lengths <= whole else -1
    for name in (form,) if form else _DIGITS.get(length, ()):
        with suppress(ValueError, OverflowError, OSError):
            fits[name] = [_read(text, name) for text in texts]
    return fits


def is_date(text: str) -> bool:
    """Returns whether a text is a calendar time in one of the patterns."""
    return bool(_fits([text], None))


def date_within(text: str) -> str:
    """Returns the only date in a name, of several folders in the innermost; empty if none."""
    for part in reversed(text.split(FOLDERS)):
        if is_date(part):
            return part
        part = re.sub(_APART, lambda m: m[1] + re.sub(r"\D", ":", m[2]), part.replace("_", " "))
        found = {match.group() for match in _DATE.finditer(part)}
        if len(found) == 1:
            return found.pop()
    return ""


def _has_clock(dates: Sequence[datetime]) -> bool:
    """Returns whether dates have times of day: not all the same, such as midnight."""
    return len({date.time() for date in dates}) > 1


def in_utc(date: datetime) -> datetime:
    """Returns the time in UTC. A time without a zone is taken as UTC."""
    return date.astimezone(UTC) if date.tzinfo else date.replace(tzinfo=UTC)


@functools.lru_cache(1 << 16)
def _read(text: str, form: str) -> datetime:
    """Reads a text by a pattern, or by the order of its day, month and year."""
    text = text.strip()
    if form in _SINCE_1970:
        return datetime.fromtimestamp(float(text) / _SINCE_1970[form], UTC)
    if "%" in form:
        return datetime.strptime(text, form.replace("%H", "%I") if "%p" in form else form)
    if not (match := _DATE.fullmatch(text)):
        raise ValueError(text)
    part = {name: found or "" for name, found in match.groupdict().items()}
    day = "-".join(re.findall(r"\d+|(?<![a-z])[a-z]{3}", part["day"].lower()))
    zone = _OFFSETS.get(part["zone"].upper(), part["zone"])
    if part["sign"]:
        zone = f"{part['sign']}{part['hours']:0>2}{part['minutes']:0>2}"
    half = part["half"] and f"{part['half']}m"
    clock = f"{part['hour'] or '12' * bool(half):0>2}{part['minute']:0>2}{part['second']:0>2}"
    clock, clocks = f"{clock}{half}{zone}", "%I%M%S%p" if half else "%H%M%S"
    clocks += "%z" * bool(zone)
    for pattern in (*_DAYS, *_ORDERS.get(form, ())):
        with suppress(ValueError):
            return datetime.strptime(f"{day} {clock}", f"{pattern} {clocks}")
    raise ValueError(text)
