"""Reads calendar times by strict patterns; asks if several patterns fit."""

import contextlib
import functools
import re
from collections.abc import Sequence
from datetime import UTC, datetime, time, timedelta, timezone
from typing import Any

from emberlink.envs.utils.errors import UserError

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
    r"(?:\s?(?P<offset>[+-]\d\d?(?::?\d\d)?))?(?:\s?\([^)]*\))?"
)
_DAY = r"(?:(?:mon|tue|wed|thu|fri|sat|sun)[a-z]*[,.]?\s*)?(?P<day>\d.+?|[a-z]{3}.+?)"
_WRITTEN = (rf"{_DAY}(?:T|,?\s+(?:at\s+)?){_CLOCK}", _DAY)
_WITHIN = (
    r"(?<!\d)(?:(?:19|20)\d\d([-/.]?)\d\d\1\d\d|\d\d?([-/.])\d\d?\2(?:\d{4}|\d\d)"
    rf"|\d\d?[-\s]?{_MONTH}[-,\s]*\d{{4}}|{_MONTH}\s+\d\d?,?\s+\d{{4}})"
    rf"(?:(?:T|,?[\s-]+(?:at\s+)?){_CLOCK})?(?!\d)"
)

FOLDERS = " > "
"""Between the names of folders, one within the other."""


def parse_dates(texts: Sequence[str], form: str | None, key: str) -> list[datetime]:
    """Reads calendar times in one format.

    Args:
        texts: such as 2020-08-19T13:00-07:00, 8/19/2020 1:55 PM, 20200819, 1597842000000.
        form: `fire.time_format`.
        key: source of the texts, for messages.
    """
    if form is not None and form not in (*_ORDERS, *_SINCE_1970) and "%" not in form:
        known = ", ".join((*_ORDERS, *_SINCE_1970))
        raise UserError(f"fire.time_format={form}: expected {known}, or such as %d.%m.%Y")
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
        raise UserError(
            f"{key}={text[:40]!r} is not a date; expected such as 2020-08-19T13:00-07:00, or "
            "fire.time_format, such as fire.time_format=%d.%m.%Y"
        )
    first, *others = fits.values()
    if any([*map(in_utc, other)] != [*map(in_utc, first)] for other in others):
        listed = " or ".join(f"{name} ({read[0]:%Y-%m-%d %H:%M})" for name, read in fits.items())
        choices = " or ".join(f"fire.time_format={name}" for name in fits)
        raise UserError(f"{key}={texts[0][:40]!r} fits {listed}; expected {choices}")
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
        part = part if is_date(part) else part.replace("_", " ")
        part = re.sub(r"(\d{4}-\d\d-\d\d[T ]\d\d)[-.h](\d\d)(?!\d)", r"\1:\2", part)
        found = {match.group() for match in re.finditer(_WITHIN, part, re.IGNORECASE)}
        if is_date(part) or len(found) == 1:
            return part if is_date(part) else found.pop()
    return ""


@functools.lru_cache(4096)
def time_of_day(text: str) -> timedelta | None:
    """Reads 2300, 155 (HHMM), 23:00, 1:55:00, 11:55 PM; AM or PM alone begin a half of the day."""
    text = re.sub(r"(?<=:\d\d)[.,]\d+|[\s.]|(Z|UTC|GMT)$", "", text.strip(), flags=re.IGNORECASE)
    text = re.sub(r"^(?=[ap]m$)", "12", text, flags=re.IGNORECASE)
    text = re.sub(r"^(\d\d?)(\d\d)(?=[ap]m)", r"\1:\2", text, flags=re.IGNORECASE)
    if text.isdecimal():
        text = re.sub(r"(\d\d)(\d\d)(\d\d)?$", r"\1:\2:\3", text.zfill(4)).rstrip(":")
    for form in _CLOCKS:
        try:
            read = datetime.strptime(text, form)
        except ValueError:
            continue
        return timedelta(hours=read.hour, minutes=read.minute, seconds=read.second)
    return None


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
    if "%" in form:
        return datetime.strptime(text, form)
    if len(text) in (8, 12, 14) and text.isdecimal():
        return datetime.strptime(text, _DIGITS[len(text)][0])
    for written in _WRITTEN:
        match = re.fullmatch(written, text, re.IGNORECASE)
        day = match and _day(match["day"], form)
        if match and day:
            return _with_clock(day, match.groupdict())
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


def _with_clock(day: datetime, part: dict[str, Any]) -> datetime:
    """Returns a day with the time of day and the zone beside it."""
    if part.get("clock") is None:
        return day
    shift, (zone, offset) = time_of_day(part["clock"]), (part["zone"], part["offset"])
    if shift is None:
        raise ValueError(part)
    away = timedelta(hours=_ZONES[zone.upper()] if zone else 0)
    if offset:
        digits = offset[1:].replace(":", "")
        beside = timedelta(hours=int(digits[:2]), minutes=int(digits[2:] or 0))
        away += -beside if offset[0] == "-" else beside
    return (day + shift).replace(tzinfo=timezone(away) if zone or offset else None)
