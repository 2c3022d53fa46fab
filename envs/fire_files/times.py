"""Finds the times of features: elapsed or dates, in one column or more, or outside the table.

Dates are read by strict patterns. If several fit, or several columns may hold them, it is asked.
"""

import functools
import re
from collections.abc import Sequence
from contextlib import suppress
from datetime import UTC, datetime, time, timedelta
from typing import Any

import numpy as np

from emberlink.envs.fire_files.config import FileFireConfig
from emberlink.envs.fire_files.files import library
from emberlink.envs.fire_files.report import SECONDS, Clock, Report, ask
from emberlink.envs.fire_files.tables import FOLDERS, attributes, column_named, plain
from emberlink.envs.utils.validation import as_argument

_MAPPED = (
    r"(poly)?polygond\w*|polypolyg|perimeterd\w*|perdat\w*|gdbfromdat\w*|datetime|timestamp|tutc"
    r"|acqdat\w*|validat|date|time|t|begin|elapsed\w*|seconds|minutes|hours|days"
)
"""Columns of times by the letters and digits of their names, also cut to ten, as in a .dbf."""
_HOUR, _MINUTE = r"(.*hours?|hora|heure|uhr|hr|h)(utc|gmt|z|local)?", r"min(ute)?s?"
_OF_DAY = rf"{_HOUR}|{_MINUTE}|.*(time(utc|gmt|z|local)?|hhmm|clock|ampm)"
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
    12: ("%Y%m%d%H%M",),
    13: ("milliseconds",),
    14: ("%Y%m%d%H%M%S",),
}
"""Patterns of texts of digits, by their length."""
_ZONES = {"Z": "+0000", "UTC": "+0000", "GMT": "+0000", "UT": "+0000"}
_ZONES |= {"EST": "-0500", "EDT": "-0400", "CST": "-0600", "CDT": "-0500", "MST": "-0700"}
_ZONES |= {"MDT": "-0600", "PST": "-0800", "PDT": "-0700", "AKST": "-0900", "AKDT": "-0800"}
"""Zones of RFC 2822 and of Alaska."""
_MONTH = r"(?:jan|feb|mar|apr|may|jun|jul|aug|sep|oct|nov|dec)[a-z]*\.?"
_DATE = re.compile(
    r"(?<!\d)(?:(?:mon|tue|wed|thu|fri|sat|sun)[a-z]*[,.]?\s*)?(?P<day>(?:19|20)\d{6}"
    r"|\d{4}([-/.])\d\d?\2\d\d?|\d{4}-?\d{3}|\d\d?([-/.])\d\d?\3(?:\d{4}|\d\d)"
    rf"|\d\d?(?:st|nd|rd|th)?[-\s]?{_MONTH}[-,\s]*(?:\d{{4}}|\d\d)"
    rf"|{_MONTH}[-\s]+\d\d?(?:st|nd|rd|th)?,?\s+\d{{4}})"
    r"(?:(?:T|,?[\s-]+(?:at\s+)?)(?P<hour>\d\d?)(?=:?\d\d|\s?[ap]\.?m)(?::?(?P<minute>\d\d))?"
    r"(?::?(?P<second>\d\d)(?:[.,]\d+)?)?(?:\s?(?P<half>[ap])\.?m\.?)?"
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
    if len(empty := frame.index[(frame[names] == "").any(axis=1)]):
        seen = f"{empty[0]} has no time in {names[0]} ({len(empty)} of {len(frame)})"
        raise ask(seen, "one in each", f"fire.where={names[0]} to leave out those without")
    if len(names) == 1 and config.time_format is None:
        numbers = library("pandas").to_numeric(frame[names[0]], errors="coerce")
        if numbers.notna().all() and not all(map(is_date, frame[names[0]].unique())):
            about = f"{names[0]} ({numbers.min():g} to {numbers.max():g})"
            if not numbers.between(0, 1e12).all():
                raise ask(about, "times of 0 or more")
            title = plain(names[0])
            known = (u for u in SECONDS if re.fullmatch(rf"elapsed{u[:2]}\w*|{u}", title))
            unit = decided_unit(next(known, None), config, about)
            report.facts.append(f"times from {names[0]}")
            return in_order(numbers.to_numpy(float), unit, config)
    if config.time_field is None and not _has_clock(
        parse_dates([*frame[names[0]]], config.time_format, names[0])
    ):
        names += _clocks_beside(frame, names[0])
    title = " and ".join(map(str, names))
    dates = parse_dates([*_joined(frame, names)], config.time_format, title)
    aware = [date.tzinfo is not None for date in dates]
    if len({*aware}) > 1:
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
    known = [name for name in filled if name not in outside and re.fullmatch(_MAPPED, plain(name))]
    dated = [name for name in filled if is_date(next(filter(None, frame[name])))]
    found = [name for name in known if name in dated] or known
    found = found or [name for name in outside if (frame[name] != "").all()]
    if not found or frame[found].ne(frame[found[0]], axis=0).any(axis=None):
        maybe = found or [*dated, *(name for name in filled if name not in dated)][:15]
        seen = ", ".join(f"{name} ({frame[name].iloc[0][:30]})" for name in maybe)
        key = as_argument("fire.time_field", maybe[0]) if maybe else "a column of times"
        raise ask(f"which column holds the times: {seen or 'none'}?", f"{key} or such")
    return found[:1]


def _clocks_beside(frame: Any, date: Any) -> list[Any]:
    """Returns the column of times of day named as that of the dates; asks about others."""
    names = [name for name in attributes(frame) if name != date and _is_clock(name, frame[name])]
    if names and (len(names) > 1 or plain(date).replace("date", "time") != plain(names[0])):
        key = f"'fire.time_field=[{','.join([date, *names])}]' to join them"
        seen = f"{date} has no times of day, maybe {', '.join(names)} has"
        raise ask(seen, key, f"fire.time_field={date}")
    return names


def _is_clock(name: Any, column: Any) -> bool:
    values = column[column != ""]
    named = re.fullmatch(_OF_DAY, plain(name)) and values.str.match(r"\d{1,6}\b|\d\d?:\d\d").any()
    return len(values) > 0 and (named or values.str.fullmatch(r"(?i)[ap]\.?m\.?").all())


def _joined(frame: Any, names: Sequence[Any]) -> Any:
    """Joins dates with times of day in columns of hours, minutes, HHMM, HH:MM, and AM or PM."""
    joined = frame[names[0]]
    joined = joined.str.replace(_MIDNIGHT, "", regex=True) if len(names) > 1 else joined
    for place, name in enumerate(names[1:]):
        part, title = frame[name], plain(name)
        if re.fullmatch(_MINUTE, title):
            joined = joined.str.removesuffix(":00") + ":" + part.str.zfill(2)
            continue
        digits = part.str.isdecimal()
        short = digits & (part.str.len() < 3) & (re.fullmatch(_HOUR, title) is not None)
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
    if unit == "day_of_year":
        values = np.where(values < first, values + gaps.sum(), values)
    elif config.start is None and cyclic and last < len(days) - 1 and gaps[last] > 183:
        seen = f"days {days[0]:g} to {days[last]:g} and {first:g} to {days[-1]:g}, over New Year?"
        raise ask(seen, "fire.units=day_of_year", f"fire.start={days[0]:g} for days as they are")
    return values, Clock(unit, origin)


def parse_dates(texts: Sequence[str], form: str | None, key: str) -> list[datetime]:
    """Reads calendar times in one format: `form`, which is `fire.time_format`, or the only fit."""
    distinct = [*dict.fromkeys(texts)]
    fits, wrong = {}, distinct[0]
    for name in (form,) if form else _forms(distinct):
        with suppress(ValueError, OverflowError, OSError):
            fits[name] = [_read(wrong := text, name) for text in distinct]
    if not fits:
        raise ask(f"{key}={wrong[:40]!r} is not a date", "such as fire.time_format=%d.%m.%Y")
    if len({tuple(map(in_utc, dates)) for dates in fits.values()}) > 1:
        listed = " or ".join(f"{name} ({read[0]:%Y-%m-%d %H:%M})" for name, read in fits.items())
        keys = map("fire.time_format={}".format, fits)
        raise ask(f"{key}={texts[0][:40]!r} fits {listed}", *keys)
    read = dict(zip(distinct, next(iter(fits.values())), strict=True))
    return [read[text] for text in texts]


def _forms(texts: Sequence[str]) -> tuple[str, ...]:
    """Returns the patterns that may fit texts: of digits, if all have as many, or the orders."""
    lengths = {len(text) if text.isdecimal() else 0 for text in texts}
    return _DIGITS.get(min(lengths), _ORDERS) if len(lengths) == 1 else _ORDERS


def is_date(text: str) -> bool:
    """Returns whether a text is a calendar time in one of the patterns."""
    for form in _forms([text]) if not text.isdecimal() or len(text) in _DIGITS else ():
        with suppress(ValueError, OverflowError, OSError):
            return bool(_read(text, form))
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
    text = text.strip()
    if form in _SINCE_1970:
        return datetime.fromtimestamp(float(text) / _SINCE_1970[form], UTC)
    if "%" in form:
        return datetime.strptime(text, form)
    if not (match := _DATE.fullmatch(text)):
        raise ValueError(text)
    part = {name: found or "" for name, found in match.groupdict().items()}
    day = "-".join(re.findall(r"\d+|(?<![a-z])[a-z]{3}", part["day"].lower()))
    zone = _ZONES.get(part["zone"].upper(), "")
    if part["sign"]:
        zone = f"{part['sign']}{part['hours']:0>2}{part['minutes']:0>2}"
    clock = f"{part['hour']:0>2}{part['minute']:0>2}{part['second']:0>2}{part['half']}"
    clocks = f"{'%I%M%S%p' if part['half'] else '%H%M%S'}{'%z' if zone else ''}"
    clock += "m" * bool(part["half"]) + zone
    for pattern, needs in _DAYS.items():
        with suppress(ValueError):
            if needs in ("", form):
                return datetime.strptime(f"{day} {clock}", f"{pattern} {clocks}")
    raise ValueError(text)
