"""Finds the times of features: elapsed or dates, in one column or more, or outside the table.

Dates are read by strict patterns. If several fit, or several columns may hold them, it is asked.
"""

import contextlib
import functools
import re
from collections.abc import Sequence
from datetime import UTC, datetime, time, timedelta, timezone
from typing import Any

import numpy as np

from emberlink.envs.fire_files.config import FileFireConfig
from emberlink.envs.fire_files.files import library
from emberlink.envs.fire_files.report import Clock, Report, ask
from emberlink.envs.fire_files.tables import FOLDERS, attributes, column_named, plain
from emberlink.envs.utils.validation import as_argument

_ELAPSED = {
    "minutes": r"elapsedmi\w*|minutes",
    "seconds": r"elapsedse?c?\w*|seconds",
    "hours": r"elapsedho?\w*|hours",
    "days": r"elapsedda\w*|days",
}
_MAPPED = (
    r"(poly)?polygond\w*|polypolyg|perimeterd\w*|perdat\w*|gdbfromdat\w*|datetime|timestamp|tutc"
    r"|acqdat\w*|validat|date|time|t|begin"
)
_EDITED = r"(poly)?datecur\w*|polydatec"
"""Columns of elapsed time; of the time when a perimeter was mapped; when a record was changed.

By the letters and digits of their names, also of those cut to ten letters, as in a .dbf.
"""
_HOUR, _MINUTE = r"(hours?|hora|heure|hr|h)(utc|gmt|z|local)?", r"min(ute)?s?"
_OF_DAY = rf"(.*?)(time(utc|gmt|z|local)?|{_HOUR}|uhr|hhmm|clock|ampm)"
_MIDNIGHT = r"[T ](00:00(:00)?([.]0+)?|12:00(:00)? AM)(Z|[+]00(:?00)?)?$"
_DAYS = {
    **dict.fromkeys(("%Y-%m-%d", "%Y-%j", "%d-%b-%Y", "%d-%b-%y", "%b-%d-%Y", "%Y%m%d"), ""),
    **dict.fromkeys(("%d-%m-%Y", "%d-%m-%y"), "day_first"),
    **dict.fromkeys(("%m-%d-%Y", "%m-%d-%y"), "month_first"),
    "%y-%m-%d": "year_first",
}
"""Patterns of days, and the `fire.time_format` that each needs; - is any separator."""
_ORDERS = ("day_first", "month_first", "year_first")
_SINCE_1970 = {"seconds": 1, "milliseconds": 1000}
_DIGITS = {
    8: ("%Y%m%d",),
    10: ("seconds", "%y%m%d%H%M", "%Y%m%d%H"),
    12: ("%Y%m%d%H%M", "milliseconds"),
    13: ("milliseconds",),
    14: ("%Y%m%d%H%M%S",),
}
"""Patterns of texts of digits, by their length."""
_ZONES = {"Z": 0, "UTC": 0, "GMT": 0, "UT": 0, "EST": -5, "EDT": -4, "CST": -6, "CDT": -5}
_ZONES |= {"MST": -7, "MDT": -6, "PST": -8, "PDT": -7, "AKST": -9, "AKDT": -8}
"""Zones of RFC 2822 and of Alaska, hours."""
_MONTH = r"(?:jan|feb|mar|apr|may|jun|jul|aug|sep|oct|nov|dec)[a-z]*\.?"
_DATE = re.compile(
    r"(?<!\d)(?:(?:mon|tue|wed|thu|fri|sat|sun)[a-z]*[,.]?\s*)?(?P<day>(?:19|20)\d{6}"
    r"|\d{4}([-/.])\d\d?\2\d\d?|\d{4}-?\d{3}|\d\d?([-/.])\d\d?\3(?:\d{4}|\d\d)"
    rf"|\d\d?(?:st|nd|rd|th)?[-\s]?{_MONTH}[-,\s]*(?:\d{{4}}|\d\d)"
    rf"|{_MONTH}[-\s]+\d\d?(?:st|nd|rd|th)?,?\s+\d{{4}})"
    r"(?:(?:T|,?[\s-]+(?:at\s+)?)(?P<hour>\d\d?)(?::?(?P<minute>\d\d)(?::?(?P<second>\d\d))?"
    r"(?:[.,]\d+)?(?:\s?(?P<half>[ap])\.?m\.?)?|\s?(?P<only>[ap])\.?m\.?)"
    rf"(?:\s?(?P<zone>{'|'.join(sorted(_ZONES, key=len, reverse=True))})\b)?"
    r"(?:\s?(?P<sign>[+-])(?P<hours>\d\d?)(?::?(?P<minutes>\d\d))?)?(?:\s?\([^)]*\))?)?(?!\d)",
    re.IGNORECASE,
)
"""A day, with or without a time of day and its zone."""


def read_times(
    frame: Any, config: FileFireConfig, outside: Sequence[str], report: Report
) -> tuple[np.ndarray, Clock]:
    """Returns the time of each feature; the values of columns `outside` stand beside the table."""
    if "%" not in (config.time_format or ""):  # of names and descriptions, only the date in them
        loose = [name for name in attributes(frame) if name in (*outside, "Description")]
        frame = frame.assign(**{name: frame[name].map(date_within) for name in loose})
    names = _columns(frame, config.time_field, outside)
    written = frame[names[0]]
    if len(empty := frame.index[(frame[names] == "").any(axis=1)]):
        seen = f"{empty[0]} has no time in {names[0]} ({len(empty)} of {len(frame)})"
        raise ask(seen, "one in each", f"fire.where={names[0]} to leave out those without")
    if len(names) == 1 and config.time_format is None:
        numbers = library("pandas").to_numeric(written, errors="coerce")
        if numbers.notna().all() and not all(map(is_date, written.unique())):
            about = f"{names[0]} ({numbers.min():g} to {numbers.max():g})"
            if not numbers.between(0, 1e12).all():
                raise ask(about, "times of 0 or more")
            known = (u for u, form in _ELAPSED.items() if re.fullmatch(form, plain(names[0])))
            unit = decided_unit(next(known, None), config, about)
            report.facts.append(f"times from {names[0]}")
            return in_order(numbers.to_numpy(float), unit, config)
    if len(names) == 1 and not _has_clock(parse_dates([*written], config.time_format, names[0])):
        names += _clocks_beside(frame, names[0], asked=config.time_field is None)
    title = " and ".join(map(str, names))
    dates = parse_dates([*_joined(frame, names)], config.time_format, title)
    aware = [date.tzinfo is not None for date in dates]
    if any(aware) and not all(aware):
        some, other = frame.index[aware.index(True)], frame.index[aware.index(False)]
        raise ask(f"{title}: {some} has a time zone and {other} has none", "one in all")
    zone = "zone of the file" if all(aware) else "no zone in the file, read as UTC"
    report.facts.append(f"times from {title}, {zone}")
    moments = [in_utc(date) for date in dates]
    first, last = min(moments), max(moments)
    values = np.array([(moment - first) / timedelta(minutes=1) for moment in moments])
    if last > datetime.now(UTC) + timedelta(days=1):
        report.doubts.append(f"{last:%Y-%m-%d} is in the future")
    days = np.unique(values) if not _has_clock(dates) else ()
    if within := sum(_nested(frame.geometry[values == day]) for day in days):
        report.doubts.append(
            f"{len(frame)} features have {len(days)} dates in {title} without a time of day, and "
            f"perimeters of one date lie in one another ({within} dates): their order is lost"
        )
    return values, Clock("minutes", first)


def _columns(frame: Any, given: str | Sequence[str] | None, outside: Sequence[str]) -> list[Any]:
    """Returns the columns of `fire.time_field`, or the column with a known name; asks if unsure."""
    if given is not None:
        given = (given,) if isinstance(given, str) else given
        return [column_named(name, frame, "fire.time_field") for name in given]
    filled = [name for name in attributes(frame) if (frame[name] != "").any()]
    if "Folder" in frame and "TimeStamp" in filled and (frame["TimeStamp"] != "").all():
        return ["TimeStamp"]  # of KML
    elapsed, mapped, edited = (
        [name for name in filled if name not in outside and re.fullmatch(form, plain(name))]
        for form in ("|".join(_ELAPSED.values()), _MAPPED, _EDITED)
    )
    dated = [name for name in filled if is_date(next(filter(None, frame[name])))]
    mapped = [name for name in mapped if name in dated] or mapped
    timed = [name for name in mapped if frame[name].str.contains(r"\d[T ]\d|\d{10}").any()]
    elapsed = [n for n in elapsed if plain(n).startswith("elapsed") or not {*mapped} & {*dated}]
    beside = [name for name in outside if (frame[name] != "").all()]
    found = elapsed or timed or mapped or edited or beside
    maybe = found or sorted(filled, key=lambda name: name not in dated)[:15]
    if not found or frame[found].ne(frame[found[0]], axis=0).any(axis=None):
        seen = ", ".join(f"{name} ({frame[name].iloc[0][:30]})" for name in maybe)
        key = as_argument("fire.time_field", maybe[0]) if maybe else "a column of times"
        raise ask(f"which column holds the times: {seen or 'none'}?", f"{key} or such")
    return found[:1]


def _clocks_beside(frame: Any, date: Any, *, asked: bool) -> list[Any]:
    """Returns the columns of times of day that belong to a column of dates; asks if unsure."""
    found, halves, minutes = {}, [], []
    for name in attributes(frame):
        values, match = frame[name][frame[name] != ""], re.fullmatch(_OF_DAY, plain(name))
        if len(values) and values.str.fullmatch(r"(?i)[ap]\.?m\.?").all():
            halves.append(name)
        elif re.fullmatch(_MINUTE, plain(name)):
            minutes.append(name)
        elif name != date and match and values.str.match(r"\d{1,6}\b|\d\d?:\d\d").any():
            found[name] = match[1]
    stem = re.sub(r"(date|day|datum|fecha|data)", "", plain(date))
    paired = [name for name, rest in found.items() if rest == stem]
    if len(paired) == 1:
        return [*paired, *(minutes if re.fullmatch(_HOUR, plain(paired[0])) else []), *halves]
    if (names := [*found, *halves]) and asked:
        join = f"'fire.time_field=[{date},{names[0]}]' to join them"
        raise ask(
            f"{date} has no times of day, maybe {', '.join(names)} has",
            join,
            f"fire.time_field={date}",
        )
    return []


def _joined(frame: Any, names: Sequence[Any]) -> Any:
    """Joins dates with times of day in columns of hours, minutes, HHMM, HH:MM, and AM or PM."""
    joined = frame[names[0]]
    joined = joined.str.replace(_MIDNIGHT, "", regex=True) if len(names) > 1 else joined
    for place, name in enumerate(names[1:]):
        part = frame[name]
        if re.fullmatch(_MINUTE, plain(name)):
            joined = joined.str.replace(":00$", ":", regex=True) + part.str.zfill(2)
            continue
        digits, hours = part.str.isdecimal(), re.fullmatch(f".*?{_HOUR}", plain(name)) is not None
        short = digits & (part.str.len() < 3) & hours
        part = part.mask(digits, part.str.zfill(4)).mask(short, part + ":00")
        if place == 0:  # AM or PM alone begins a half of the day
            part = part.str.replace(r"(?i)^(?=[ap]\.?m)", "12 ", regex=True)
        joined += " " + part
    return joined


def _nested(shapes: Any) -> bool:
    """Returns whether one of some shapes lies in another that is larger by a tenth or more."""
    areas = shapes.convex_hull
    inner, outer = areas.sindex.query(areas, predicate="covered_by")
    sizes = areas.area.to_numpy()
    return bool((sizes[inner] < 0.9 * sizes[outer]).any())


def decided_unit(known: str | None, config: FileFireConfig, what: str) -> str:
    """Returns the unit of the file or of the key; asks if there is none or they differ."""
    unit = config.units or known
    if unit is None:
        some = "fire.units=minutes (FARSITE, FlamMap), seconds (ELMFIRE, WRF-SFIRE) or such"
        raise ask(f"the unit of {what} is not known", some)
    if known not in (None, unit) and {known, unit} != {"days", "day_of_year"}:
        raise ask(f"{what} is in {known}", f"fire.units={known}, not {unit}")
    return unit


def in_order(
    values: np.ndarray, unit: str, config: FileFireConfig, origin: datetime | None = None
) -> tuple[np.ndarray, Clock]:
    """Returns times with their clock, days of the year continued over New Year; asks if unsure."""
    if unit not in ("days", "day_of_year"):
        return values, Clock(unit, origin)
    days = np.unique(values[np.isfinite(values)])
    gaps = np.diff(days, append=days[0] + (366 if days[-1] > 365 else 365))
    last = int(gaps.argmax())
    first = days[(last + 1) % len(days)]
    cyclic = days[0] >= 1 and days[-1] <= 366 and (days % 1 == 0).all()
    if config.units == "day_of_year":
        values = np.where(values < first, values + gaps.sum(), values)
    elif config.start is None and cyclic and last < len(days) - 1 and gaps[last] > 183:
        seen = f"days {days[0]:g} to {days[last]:g} and {first:g} to {days[-1]:g}, over New Year?"
        raise ask(seen, "fire.units=day_of_year", f"fire.start={days[0]:g} for days as they are")
    return values, Clock("days", origin)


def parse_dates(texts: Sequence[str], form: str | None, key: str) -> list[datetime]:
    """Reads calendar times in one format: `form`, which is `fire.time_format`, or the only fit."""
    known = (*_ORDERS, *_SINCE_1970)
    if form is not None and form not in known and "%" not in form:
        raise ask(f"fire.time_format={form}", ", ".join(known), "such as %d.%m.%Y")
    distinct = [*dict.fromkeys(texts)]
    lengths = {len(text) if text.isdecimal() else 0 for text in distinct}
    forms = _DIGITS.get(lengths.pop(), _ORDERS) if len(lengths) == 1 else _ORDERS
    fits, text = {}, ""
    for name in (form,) if form else forms:
        with contextlib.suppress(ValueError, OverflowError, OSError):
            fits[name] = [_read((text := each).strip(), name) for each in distinct]
    if form is None and forms is not _ORDERS:
        now = datetime.now(UTC) + timedelta(days=1)
        likely = {n for n, d in fits.items() if max(map(in_utc, d)) < now and d[0].year > 1980}
        fits = {name: fits[name] for name in fits if name in likely} or fits
    if not fits:
        raise ask(f"{key}={text[:40]!r} is not a date", "such as fire.time_format=%d.%m.%Y")
    if len({tuple(map(in_utc, dates)) for dates in fits.values()}) > 1:
        listed = " or ".join(f"{name} ({read[0]:%Y-%m-%d %H:%M})" for name, read in fits.items())
        raise ask(
            f"{key}={texts[0][:40]!r} fits {listed}", *map("fire.time_format={}".format, fits)
        )
    read = dict(zip(distinct, next(iter(fits.values())), strict=True))
    return [read[text] for text in texts]


def is_date(text: str) -> bool:
    """Returns whether a text is a calendar time in one of the patterns."""
    for form in _DIGITS.get(len(text), ()) if text.isdecimal() else _ORDERS:
        with contextlib.suppress(ValueError, OverflowError):
            return bool(_read(text.strip(), form))
    return False


def date_within(text: str) -> str:
    """Returns the only date in a name, of several folders in the innermost; empty if none."""
    for part in reversed(text.split(FOLDERS)):
        if is_date(part):
            return part
        part = re.sub(r"(\d\d-\d\d[T ]\d\d)[-.h](\d\d)(?!\d)", r"\1:\2", part.replace("_", " "))
        found = {match.group() for match in _DATE.finditer(part)}
        if len(found) == 1:
            return found.pop()
    return ""


def _has_clock(dates: Sequence[datetime]) -> bool:
    """Returns whether one of some dates has a time of day other than midnight."""
    return any(date.time() != time() for date in dates)


def in_utc(date: datetime) -> datetime:
    """Returns the time in UTC. A time without a zone is taken as UTC."""
    return date.astimezone(UTC) if date.tzinfo else date.replace(tzinfo=UTC)


@functools.lru_cache(1 << 16)
def _read(text: str, form: str) -> datetime:
    """Reads a text by a pattern, or by the order of its day, month and year."""
    if form in _SINCE_1970:
        return datetime.fromtimestamp(float(text) / _SINCE_1970[form], UTC)
    if "%" in form:
        return datetime.strptime(text, form)
    if not (match := _DATE.fullmatch(text)):
        raise ValueError(text)
    day = "-".join(re.findall(r"\d+|(?<![a-z])[a-z]{3}", match["day"].lower()))
    hour, minute, second, hours, minutes = (
        int(match[name] or 0) for name in ("hour", "minute", "second", "hours", "minutes")
    )
    if half := match["half"] or match["only"]:
        hour = hour % 12 + 12 * (half in "pP") if 1 <= hour <= 12 else 24  # 24 is none
    zone = None
    if match["zone"] or match["sign"]:
        away = timedelta(hours=hours, minutes=minutes) * (-1 if match["sign"] == "-" else 1)
        zone = timezone(away + timedelta(hours=_ZONES[(match["zone"] or "Z").upper()]))
    for pattern, needs in _DAYS.items():
        with contextlib.suppress(ValueError):
            if needs in ("", form):
                return datetime.strptime(day, pattern).replace(
                    hour=hour, minute=minute, second=second, tzinfo=zone
                )
    raise ValueError(text)
