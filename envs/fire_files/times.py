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
from emberlink.envs.fire_files.tables import FOLDERS, attributes, column_named, plain, texts

Times = tuple[np.ndarray, Clock]
"""A number for each feature, and its unit."""
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
    r"(?P<clock>\d\d?(?::\d\d){1,2}(?:[.,]\d+)?(?:\s?[ap]\.?m\.?)?|\d\d?\s?[ap]\.?m\.?"
    r"|(?<=\d\d[\sT])\d{4}(?:\d\d)?)"
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
    given = config.time_field
    if given is None:
        chosen = _candidates(frame, [n for n in attributes(frame) if n not in outside], config)
    else:
        given = (given,) if isinstance(given, str) else given
        chosen = [column_named(name, attributes(frame), "fire.time_field") for name in given]
    names = (*outside, "Description")
    if not chosen or (chosen[0] in names and not _holds_dates(frame[chosen[0]])):
        return _outside(frame, chosen or outside, config, report)
    empty = frame.index[frame[chosen].isna().any(axis=1)]
    if len(empty):
        seen = f"{empty[0]} has no time in {chosen[0]} ({len(empty)} of {len(frame)})"
        raise ask(seen, "one in each", f"fire.where={chosen[0]} to leave out those without")
    written = texts(frame[chosen[0]])
    if len(chosen) == 1 and config.time_format is None:
        numbers = library("pandas").to_numeric(written, errors="coerce")
        if numbers.notna().all() and not all(map(is_date, written.unique())):
            return _elapsed(chosen[0], numbers.astype(float), config, report)
    read = _dates(written, config)
    if len(chosen) == 1 and not has_clock(read):
        chosen += _clocks_beside(frame, chosen[0], asked=given is None)
    if len(chosen) > 1:
        read = [day + shift for day, shift in zip(read, _clocks(frame, chosen[1:]), strict=True)]
    return _calendar(frame, read, " and ".join(map(str, chosen)), report)


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
    timed = [name for name in dated if has_clock(_dates(texts(frame[name].dropna()), config))]
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
        values = texts(frame[name].dropna()).unique()
        match = re.fullmatch(_OF_DAY, plain(name))
        if len(values) and all(re.fullmatch(r"(?i)\s*[ap]\.?m\.?\s*", text) for text in values):
            halves.append(name)
        elif name != date and match and any(time_of_day(text) is not None for text in values):
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


def _clocks(frame: Any, names: Sequence[Any]) -> list[timedelta]:
    """Reads the times of day in columns of hours, minutes, HHMM, HH:MM, and AM or PM."""
    joined = texts(frame[names[0]])
    for name in names[1:]:
        minutes = re.fullmatch(rf".*{_MINUTE}", plain(name))
        joined += texts(frame[name]).map(":{:>02}".format if minutes else " {}".format)
    if re.fullmatch(rf".*{_HOUR}(utc|gmt|z|local)?", plain(names[0])):
        joined = joined.str.replace(r"^(\d\d?)(?=$| )", r"\1:00", regex=True)
    read = {text: time_of_day(text) for text in joined.unique()}
    for text, shift in read.items():
        if shift is None:
            seen = f"{joined.index[joined == text][0]} has {' and '.join(map(str, names))}={text}"
            raise ask(seen, "a time of day such as 2300, 23:00 or 11:00 PM")
    return [read[text] or timedelta(0) for text in joined.tolist()]


def _outside(frame: Any, outside: Sequence[str], config: FileFireConfig, report: Report) -> Times:
    """Reads the dates in names of placemarks, folders and files, or beside the features."""
    found = {}
    for name in outside:
        written = [date_within(str(value)) for value in frame[name]]
        if all(written):
            found[name] = parse_dates(written, config.time_format, name)
    first = next(iter(found), "")
    if any(dates != found[first] for dates in found.values()):
        raise ask(f"dates in {' and in '.join(found)} differ", f"fire.time_field={first} or such")
    if found:
        return _calendar(frame, found[first], first, report)
    columns = [name for name in attributes(frame) if name not in outside]
    columns = [name for name in columns if _holds_dates(frame[name])] or columns
    if not columns:
        raise ask("no attribute or name holds times", "perimeters with times")
    seen = ", ".join(f"{name} ({str(frame[name].iloc[0])[:30]})" for name in columns[:15])
    raise ask(f"no column of times is known, of {seen}", f"such as fire.time_field={columns[0]}")


def _calendar(frame: Any, dates: Sequence[datetime], name: str, report: Report) -> Times:
    """Returns minutes since the first date."""
    aware = [date.tzinfo is not None for date in dates]
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
    known = next((unit for unit, names in _ELAPSED.items() if plain(name) in _known(names)), None)
    unit = decided_unit(known, config, f"{name} ({values.min():g} to {values.max():g})")
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
    fits: dict[str, list[datetime]] = {}
    text = ""
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


def _read(text: str, form: str) -> datetime:
    """Reads a text by a pattern, or by the order of its day, month and year."""
    if form in _SINCE_1970:
        return datetime.fromtimestamp(float(text) / _SINCE_1970[form], UTC)
    if len(text) in (8, 12, 14) and text.isdecimal() and "%" not in form:
        form = _DIGITS[len(text)][0]
    if "%" in form:
        return datetime.strptime(text, form)
    for written in _WRITTEN:
        match = re.fullmatch(written, text, re.IGNORECASE)
        if not match or not (day := _day(match["day"], form)):
            continue
        part = match.groupdict()
        if part.get("clock") is None:
            return day
        if (shift := time_of_day(part["clock"])) is None:
            break
        away = timedelta(hours=_ZONES[part["zone"].upper()] if part["zone"] else 0)
        beside = timedelta(hours=int(part["hours"] or 0), minutes=int(part["minutes"] or 0))
        zone = timezone(away - beside if part["sign"] == "-" else away + beside)
        return (day + shift).replace(tzinfo=zone if part["zone"] or part["sign"] else None)
    raise ValueError(text)


@functools.lru_cache(4096)
def _day(text: str, order: str) -> datetime | None:
    """Reads a day; None if no pattern fits."""
    text = re.sub(r"^(\d{4})(?:(\d{3})|(\d\d)(\d\d))$", r"\1-\2\3-\4", text).rstrip("-")
    text = re.sub(r"(?<=\d)(st|nd|rd|th)\b", "", text, flags=re.IGNORECASE)
    text = re.sub(_MONTH, r"-\1-", text, flags=re.IGNORECASE)
    text = re.sub(r"[-/.,\s]+", "-", text).strip("-")
    for form, needs in _DAYS.items():
        with contextlib.suppress(ValueError):
            if needs in ("", order):
                return datetime.strptime(text, form)
    return None


@functools.lru_cache(4096)
def time_of_day(text: str) -> timedelta | None:
    """Reads 2300, 155 (HHMM), 23:00, 1:55:00, 11:55 PM; AM or PM alone begin a half of the day."""
    text = re.sub(r"(?<=:\d\d)[.,]\d+|[\s.]|(Z|UTC|GMT)$", "", text.strip(), flags=re.IGNORECASE)
    text = re.sub(r"^(?=[ap]m$)", "12", text, flags=re.IGNORECASE)
    text = re.sub(r"^(\d\d?)(\d\d)(?=[ap]m)", r"\1:\2", text, flags=re.IGNORECASE)
    if text.isdecimal():
        text = re.sub(r"(\d\d)(\d\d)(\d\d)?$", r"\1:\2:\3", text.zfill(4)).rstrip(":")
    for form in _CLOCKS:
        with contextlib.suppress(ValueError):
            return datetime.strptime(text, form) - datetime(1900, 1, 1)
    return None
