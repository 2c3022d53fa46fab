"""Finds the times of features: elapsed or dates, in one column or more, or outside the table.

Dates are read by strict patterns. If several fit, or several columns may hold them, it is asked.
"""

import contextlib
import functools
import itertools
import re
from collections.abc import Sequence
from datetime import UTC, datetime, time, timedelta, timezone
from typing import Any

import numpy as np

from emberlink.envs.fire_files.config import FileFireConfig
from emberlink.envs.fire_files.files import library
from emberlink.envs.fire_files.report import Clock, Report, ask
from emberlink.envs.fire_files.tables import FOLDERS, attributes, column_named, plain, texts
from emberlink.envs.utils.validation import as_argument

Times = tuple[np.ndarray, Clock]
"""A number for each feature, and its unit."""
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
_HOUR, _MINUTE = r"(hours?|hora|heure|hr|h)", r"min(ute)?s?"
_OF_DAY = rf"(.*?)(time|{_HOUR}|uhr|hhmm|clock|ampm)(utc|gmt|z|local)?"
_OF_HOURS = rf".*?{_HOUR}(utc|gmt|z|local)?"
_MIDNIGHT = r"[T ](00:00(:00)?([.]0+)?|12:00(:00)? AM)(Z|[+]00(:?00)?)?$"
_DAYS = {
    **dict.fromkeys(("%Y-%m-%d", "%Y-%j", "%d-%b-%Y", "%d-%b-%y", "%b-%d-%Y"), ""),
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
_CLOCKS = ("%H:%M:%S", "%H:%M", "%I:%M:%S%p", "%I:%M%p", "%I%p")
_ZONES = {"Z": 0, "UTC": 0, "GMT": 0, "UT": 0, "EST": -5, "EDT": -4, "CST": -6, "CDT": -5}
_ZONES |= {"MST": -7, "MDT": -6, "PST": -8, "PDT": -7, "AKST": -9, "AKDT": -8}
"""Zones of RFC 2822 and of Alaska, hours."""
_MONTH = r"(jan|feb|mar|apr|may|jun|jul|aug|sep|oct|nov|dec)[a-z]*\.?"
_CLOCK = (
    r"(?P<clock>\d\d?(?::\d\d){1,2}|(?<=\d\d[\sT])\d{4}(?:\d\d)?|\d\d?(?=\s?[ap]\.?m))"
    r"(?:[.,]\d+)?(?:\s?(?P<half>[ap]\.?m\.?))?"
    rf"(?:\s?(?P<zone>{'|'.join(sorted(_ZONES, key=len, reverse=True))})\b)?"
    r"(?:\s?(?P<sign>[+-])(?P<hours>\d\d?)(?::?(?P<minutes>\d\d))?)?(?:\s?\([^)]*\))?"
)
_DAY = r"(?:(?:mon|tue|wed|thu|fri|sat|sun)[a-z]*[,.]?\s*)?(?P<day>\d.+?|[a-z]{3}.+?)"
_WRITTEN = (rf"{_DAY}(?:T|,?\s+(?:at\s+)?){_CLOCK}", _DAY)
_WITHIN = (
    r"(?<!\d)(?:(?:19|20)\d\d([-/.]?)\d\d\1\d\d|\d\d?([-/.])\d\d?\2(?:\d{4}|\d\d)"
    rf"|\d\d?[-\s]?{_MONTH}[-,\s]*\d{{4}}|{_MONTH}\s+\d\d?,?\s+\d{{4}})"
    rf"(?:(?:T|,?[\s-]+(?:at\s+)?){_CLOCK})?(?!\d)"
)


def read_times(frame: Any, config: FileFireConfig, outside: Sequence[str], report: Report) -> Times:
    """Returns the time of each feature; the values of columns `outside` stand beside the table."""
    columns, given, whole = attributes(frame), config.time_field, frame
    if "%" not in (config.time_format or ""):  # of names and descriptions, only the date in them
        loose = [name for name in columns if name in (*outside, "Description")]
        dated = {name: frame[name].astype(str).map(date_within).replace("", None) for name in loose}
        frame = frame.assign(**dated)
    if given is None:
        chosen = _candidates(frame, [name for name in columns if name not in outside])
        chosen = chosen or _outside(frame, outside, config)
    else:
        given = (given,) if isinstance(given, str) else given
        chosen = [column_named(name, columns, "fire.time_field") for name in given]
    if not chosen:
        columns = sorted(columns, key=lambda name: not _holds_dates(frame[name]))
        seen = ", ".join(f"{name} ({str(whole[name].iloc[0])[:30]})" for name in columns[:15])
        key = as_argument("fire.time_field", str(columns[0])) if columns else "a column of times"
        some = f"{key} or such, and fire.time_format if its form is unusual"
        raise ask(f"no column of times is known, of {seen or 'none'}", some)
    empty = frame.index[frame[chosen].isna().any(axis=1)]
    if len(empty):
        seen = f"{empty[0]} has no time in {chosen[0]} ({len(empty)} of {len(frame)})"
        raise ask(seen, "one in each", f"fire.where={chosen[0]} to leave out those without")
    written = texts(frame[chosen[0]])
    if len(chosen) == 1 and config.time_format is None:
        numbers = library("pandas").to_numeric(written, errors="coerce")
        if numbers.notna().all() and not all(map(is_date, written.unique())):
            return _elapsed(chosen[0], numbers.astype(float), config, report)
    if len(chosen) == 1 and not has_clock(_dates(written, config)):
        chosen += _clocks_beside(frame, chosen[0], asked=given is None)
    return _calendar(frame, _dates(_joined(frame, chosen), config), chosen, report)


def _outside(frame: Any, outside: Sequence[str], config: FileFireConfig) -> list[str]:
    """Returns the column that stands outside the features and holds dates; asks if two differ."""
    found = [name for name in outside if frame[name].notna().all()]
    dates = [_dates(texts(frame[name]), config) for name in found]
    if any(other != dates[0] for other in dates):
        seen = f"dates in {' and in '.join(found)} differ"
        raise ask(seen, f"fire.time_field={found[0]} or such")
    return found[:1]


def _candidates(frame: Any, columns: Sequence[Any]) -> list[Any]:
    """Returns the column with a known name; asks if several are left."""
    if "Folder" in frame and "TimeStamp" in columns and frame["TimeStamp"].notna().all():
        return ["TimeStamp"]  # of KML
    elapsed, mapped, edited = (
        [n for n in columns if re.fullmatch(names, plain(n)) and frame[n].notna().any()]
        for names in ("|".join(_ELAPSED.values()), _MAPPED, _EDITED)
    )
    dated = [name for name in mapped if _holds_dates(frame[name])]
    timed = [name for name in dated if texts(frame[name]).str.contains(r"\d[T ]\d|\d{10}").any()]
    elapsed = [name for name in elapsed if not dated or plain(name).startswith("elapsed")]
    found = elapsed or timed or dated or mapped or edited
    if len(found) > 1:
        seen = f"the columns {', '.join(map(str, found))} may hold the times"
        raise ask(seen, f"fire.time_field={found[0]} or such")
    return found


def _holds_dates(column: Any) -> bool:
    values = texts(column.dropna())
    return len(values) > 0 and is_date(values.iloc[0])


def _dates(written: Any, config: FileFireConfig) -> list[datetime]:
    """Returns a date for each text; each distinct one is read once."""
    distinct = list(written.unique())
    dates = parse_dates(distinct, config.time_format, str(written.name))
    read = dict(zip(distinct, dates, strict=True))
    return [read[text] for text in written.tolist()]


def _clocks_beside(frame: Any, date: Any, *, asked: bool) -> list[Any]:
    """Returns the columns of times of day that belong to a column of dates; asks if unsure."""
    columns, found, halves = attributes(frame), {}, []
    for name in columns:
        values = texts(frame[name].dropna())
        match = re.fullmatch(_OF_DAY, plain(name))
        if len(values) and values.str.fullmatch(r"(?i)[ap]\.?m\.?").all():
            halves.append(name)
        elif name != date and match and values.str.match(r"\d{1,6}\b|\d\d?:\d\d").any():
            found[name] = match[1]
    stem = re.sub(r"(date|day|datum|fecha|data)", "", plain(date))
    paired = [name for name, rest in found.items() if rest == stem]
    if len(paired) == 1:
        minutes = [name for name in columns if re.fullmatch(_MINUTE, plain(name))]
        return [*paired, *(minutes if re.fullmatch(_HOUR, plain(paired[0])) else []), *halves]
    if (names := [*found, *halves]) and asked:
        seen = f"{date} holds dates without a time of day, which {', '.join(map(str, names))}"
        join = f"'fire.time_field=[{date},{names[0]}]' to join them"
        raise ask(f"{seen} may hold", join, f"fire.time_field={date}")
    return []


def _joined(frame: Any, names: Sequence[Any]) -> Any:
    """Joins dates with times of day in columns of hours, minutes, HHMM, HH:MM, and AM or PM."""
    joined = texts(frame[names[0]])
    joined = joined.str.replace(_MIDNIGHT, "", regex=True) if len(names) > 1 else joined
    for place, name in enumerate(names[1:]):
        part = texts(frame[name])
        if re.fullmatch(_MINUTE, plain(name)):
            joined = joined.str.replace(":00$", ":", regex=True) + part.str.zfill(2)
            continue
        digits, hours = part.str.isdecimal(), re.fullmatch(_OF_HOURS, plain(name)) is not None
        short = digits & (part.str.len() < 3) & hours
        part = part.mask(digits, part.str.zfill(4)).mask(short, part + ":00")
        if place == 0:  # AM or PM alone begins a half of the day
            part = part.str.replace(r"(?i)^(?=[ap]\.?m)", "12 ", regex=True)
        joined += " " + part
    return joined.rename(" and ".join(map(str, names)))


def _calendar(frame: Any, dates: Sequence[datetime], names: Sequence[Any], report: Report) -> Times:
    """Returns minutes since the first date."""
    aware, name = [date.tzinfo is not None for date in dates], " and ".join(map(str, names))
    if any(aware) and not all(aware):
        some, other = frame.index[aware.index(True)], frame.index[aware.index(False)]
        raise ask(f"{name}: {some} has a time zone and {other} has none", "one in all")
    moments = {date: in_utc(date) for date in {*dates}}
    first, last = min(moments.values()), max(moments.values())
    values = np.array([(moments[date] - first) / timedelta(minutes=1) for date in dates])
    zone = "zone of the file" if all(aware) else "no zone in the file, read as UTC"
    report.facts.append(f"times from {name}, {zone}")
    if last > datetime.now(UTC) + timedelta(days=1):
        report.doubts.append(f"{last:%Y-%m-%d} is in the future")
    days = np.unique(values) if not has_clock(dates) else ()
    if within := sum(_nested(frame.geometry[values == day]) for day in days):
        report.doubts.append(
            f"{len(frame)} features have {len(days)} dates in {name} without a time of day, and "
            f"perimeters of one date lie in one another ({within} dates): their order is lost, "
            "each date is read as one time"
        )
    return values, Clock("minutes", first)


def _nested(shapes: Any) -> bool:
    """Returns whether one of some shapes lies in another that is larger by a tenth or more."""
    areas = shapes.convex_hull
    inner, outer = areas.sindex.query(areas, predicate="covered_by")
    sizes = areas.area.to_numpy()
    return bool((sizes[inner] < 0.9 * sizes[outer]).any())


def _elapsed(name: Any, times: Any, config: FileFireConfig, report: Report) -> Times:
    """Returns elapsed times, in the unit of the column's name or of `fire.units`."""
    values = times.to_numpy()
    wrong = times[~times.between(0, 1e12)]
    if len(wrong):
        raise ask(f"{wrong.index[0]} has {name}={wrong.iloc[0]:g}", "a time of 0 or more")
    known = [unit for unit, names in _ELAPSED.items() if re.fullmatch(names, plain(name))]
    about = f"{name} ({values.min():g} to {values.max():g})"
    unit = decided_unit(known[0] if known else None, config, about)
    report.facts.append(f"times from {name}")
    if unit in ("days", "day_of_year"):
        values, unit = in_order(values, config), "days"
    return values, Clock(unit)


def decided_unit(known: str | None, config: FileFireConfig, what: str) -> str:
    """Returns the unit of the file or of the key; asks if there is none or they differ."""
    unit = config.units or known
    if unit is None:
        some = "fire.units=minutes (FARSITE, FlamMap), seconds (ELMFIRE, WRF-SFIRE), hours, days"
        raise ask(f"the unit of {what} is not known", f"{some}, day_of_year or steps")
    if known not in (None, unit) and {known, unit} != {"days", "day_of_year"}:
        raise ask(f"{what} is in {known}", f"fire.units={known}, not {unit}")
    return unit


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
        seen = f"days {days[0]:g} to {days[last]:g} and {first:g} to {days[-1]:g}, none between"
        as_they_are = f"fire.start={days[0]:g} for days as they are"
        raise ask(f"{seen}, as of a fire over New Year", "fire.units=day_of_year", as_they_are)
    return values


def parse_dates(texts: Sequence[str], form: str | None, key: str) -> list[datetime]:
    """Reads calendar times in one format: `form`, which is `fire.time_format`, or the only fit."""
    known = (*_ORDERS, *_SINCE_1970)
    if form is not None and form not in known and "%" not in form:
        raise ask(f"fire.time_format={form}", ", ".join(known), "such as %d.%m.%Y")
    lengths = {len(text) if text.isdecimal() else 0 for text in texts}
    forms = _DIGITS.get(lengths.pop(), _ORDERS) if len(lengths) == 1 else _ORDERS
    fits, text = {}, ""
    for name in (form,) if form else forms:
        with contextlib.suppress(ValueError, OverflowError, OSError):
            fits[name] = [_read((text := each).strip(), name) for each in texts]
    if form is None and forms is not _ORDERS:
        now = datetime.now(UTC) + timedelta(days=1)
        likely = {n for n, d in fits.items() if max(map(in_utc, d)) < now and d[0].year > 1980}
        fits = {name: fits[name] for name in fits if name in likely} or fits
    if not fits:
        some = "fire.time_format, such as fire.time_format=%d.%m.%Y"
        raise ask(f"{key}={text[:40]!r} is not a date", "such as 2020-08-19T13:00-07:00", some)
    first, *others = fits.values()
    if any([*map(in_utc, other)] != [*map(in_utc, first)] for other in others):
        listed = " or ".join(f"{name} ({read[0]:%Y-%m-%d %H:%M})" for name, read in fits.items())
        keys = [f"fire.time_format={name}" for name in fits]
        raise ask(f"{key}={texts[0][:40]!r} fits {listed}", *keys)
    return first


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
        part = re.sub(
            r"(\d{4}-\d\d-\d\d[T ]\d\d)[-.h](\d\d)(?!\d)", r"\1:\2", part.replace("_", " ")
        )
        found = {match.group() for match in re.finditer(_WITHIN, part, re.IGNORECASE)}
        if is_date(part) or len(found) == 1:
            return part if is_date(part) else found.pop()
    return ""


def has_clock(dates: Sequence[datetime]) -> bool:
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
    text = re.sub(r"^(\d{8})(\d{4}(?:\d\d)?)$", r"\1 \2", text)
    for written in _WRITTEN:
        if not (match := re.fullmatch(written, text, re.IGNORECASE)):
            continue
        part = dict.fromkeys(("clock", "half", "zone", "sign", "hours", "minutes"), "")
        part |= match.groupdict("")
        clock = re.sub(r"(?<!:)(\d\d)(?=\d)", r"\1:", part["clock"])
        clock += part["half"].replace(".", "")
        zone, hours = part["zone"], int(part["hours"] or 0) + int(part["minutes"] or 0) / 60
        away = timedelta(hours=_ZONES[zone.upper()] if zone else 0)
        away += timedelta(hours=-hours if part["sign"] == "-" else hours)
        forms = itertools.product(_DAYS.items(), _CLOCKS if clock else ("",))
        for (day, needs), clock_form in forms:
            with contextlib.suppress(ValueError):
                if needs in ("", form):
                    date = datetime.strptime(f"{_day(part['day'])} {clock}", f"{day} {clock_form}")
                    return date.replace(tzinfo=timezone(away) if zone or part["sign"] else None)
    raise ValueError(text)


def _day(text: str) -> str:
    """Returns a day with - between its parts."""
    text = re.sub(r"^(\d{4})(?:(\d{3})|(\d\d)(\d\d))$", r"\1-\2\3-\4", text).rstrip("-")
    text = re.sub(r"(?<=\d)(st|nd|rd|th)\b", "", text, flags=re.IGNORECASE)
    text = re.sub(_MONTH, r"-\1-", text, flags=re.IGNORECASE)
    return re.sub(r"[-/.,\s]+", "-", text).strip("-")
