"""Reads calendar times by strict patterns; asks if several patterns fit."""

import re
from collections.abc import Callable, Sequence
from datetime import UTC, datetime, time, timedelta, timezone
from typing import Any

from emberlink.envs.utils.errors import UserError

_MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
_ZONES = {"Z": 0, "UTC": 0, "GMT": 0, "UT": 0, "EST": -5, "EDT": -4, "CST": -6, "CDT": -5}
_ZONES |= {"MST": -7, "MDT": -6, "PST": -8, "PDT": -7, "AKST": -9, "AKDT": -8}
"""Zones of RFC 2822 and of Alaska, hours."""
_ORDERS = {"day_first": "DMY", "month_first": "MDY", "year_first": "YMD"}
_CLOCK = (
    r"(?P<h>\d{1,2})(?:(?::(?P<m>\d\d)(?::(?P<s>\d\d)(?:[.,]\d+)?)?)?\s?(?P<half>[ap]\.?\s?m\.?)"
    r"|:(?P<m2>\d\d)(?::(?P<s2>\d\d)(?:[.,]\d+)?)?|(?P<m3>(?<=\d\d)\d\d)(?P<s3>\d\d)?)"
)
_ZONE = (
    rf"(?:\s?(?P<zone>{'|'.join(sorted(_ZONES, key=len, reverse=True))})\b)?"
    r"(?:\s?(?P<offset>[+-]\d\d?(?::?\d\d)?))?(?:\s?\([^)]*\))?"
)
_WEEKDAY = r"(?:(?:mon|tue|wed|thu|fri|sat|sun)[a-z]*[,.]?\s*)?"
_MONTH = rf"(?P<name>(?:{'|'.join(_MONTHS)})[a-z]*)\.?"
_DAYS = (
    r"(?P<Y>\d{4})(?P<sep>[-/.])(?P<M>\d\d?)(?P=sep)(?P<D>\d\d?)",
    r"(?P<Y>(?:19|20)\d\d)(?P<M>\d\d)(?P<D>\d\d)",
    r"(?P<a>\d\d?)(?P<sep>[-/.])(?P<b>\d\d?)(?P=sep)(?P<c>\d{4}|\d\d)",
    rf"{_WEEKDAY}(?P<D>\d\d?)(?:st|nd|rd|th)?[-\s]{_MONTH}[-,\s]+(?P<Y>\d{{4}}|\d\d)",
    rf"{_WEEKDAY}{_MONTH}\s+(?P<D>\d\d?)(?:st|nd|rd|th)?,?\s+(?P<Y>\d{{4}})",
    r"(?P<Y>(?:19|20)\d\d)-?(?P<J>\d{3})",
)
_FORMS = [rf"\s*{_DAYS[1]}(?P<h>\d\d)(?P<m>\d\d)(?P<s>\d\d)?\s*"]
_FORMS += [rf"\s*{day}(?:(?:T|[\s,]+(?:at\s+)?){_CLOCK}{_ZONE})?\s*" for day in _DAYS]
_WITHIN = [rf"(?<!\d){day}(?:(?:T|[\s,_-]+(?:at\s+)?){_CLOCK}{_ZONE})?(?!\d)" for day in _DAYS[:5]]


class Date(datetime):
    """A date whose text holds no time of day."""


def parse_dates(texts: Sequence[str], form: str | None, key: str) -> list[datetime]:
    """Reads calendar times in one format; times without a time of day are `Date`.

    Args:
        texts: such as 2020-08-19T13:00-07:00, 8/19/2020 1:55 PM, 20200819, 1597842000000.
        form: `fire.time_format`.
        key: source of the texts, for messages.
    """
    fits: dict[str, list[datetime]] = {}
    wrong = texts[0]
    for name, reader in _readers(texts, form).items():
        dates: list[datetime] = []
        for text in texts:
            try:
                dates.append(reader(text.strip()))
            except (ValueError, OverflowError, OSError):
                wrong = text
                break
        else:
            fits[name] = dates
    if "seconds" in fits and form is None:  # ten digits
        now = datetime.now(UTC) + timedelta(days=1)
        fits = {name: read for name, read in fits.items() if max(map(in_utc, read)) < now} or fits
    if not fits:
        raise UserError(
            f"{key}={wrong[:40]!r} is not a date; expected such as 2020-08-19T13:00-07:00, or "
            "fire.time_format, such as fire.time_format=%d.%m.%Y"
        )
    first, *others = fits.values()
    if any(list(map(in_utc, other)) != list(map(in_utc, first)) for other in others):
        listed = " or ".join(f"{name} ({read[0]:%Y-%m-%d %H:%M})" for name, read in fits.items())
        choices = " or ".join(f"fire.time_format={name}" for name in fits)
        raise UserError(f"{key}={texts[0][:40]!r} fits {listed}; expected {choices}")
    return first


def is_date(text: str) -> bool:
    """Returns whether a text has the form of a calendar time."""
    return any(re.fullmatch(form, text, re.IGNORECASE) for form in _FORMS)


def is_stamp(numbers: Sequence[float]) -> bool:
    """Returns whether numbers are dates in digits, or milliseconds or seconds since 1970."""
    texts = {f"{number:.0f}" for number in numbers}
    whole = bool(texts) and all(number % 1 == 0 for number in numbers)
    if whole and all(len(text) in (8, 14) for text in texts):
        return all(map(is_date, texts))
    return whole and all(len(text) in (10, 12, 13) for text in texts)


def date_within(text: str) -> str:
    """Returns the only date in a name, of several folders in the innermost; empty if none."""
    for part in reversed(text.split("/")):
        part = re.sub(r"(\d{4}-\d\d-\d\d[T_ ]\d\d)[-_.h](\d\d)(?!\d)", r"\1:\2", part)
        found = {m.group().replace("_", " ") for f in _WITHIN for m in re.finditer(f, part, re.I)}
        if is_date(part) or len(found) == 1:
            return part if is_date(part) else found.pop()
    return ""


def time_of_day(value: Any, *, hours: bool = False) -> timedelta:
    """Reads 2300, 155 or 155.0 (HHMM), 23:00, 1:55:00, 11:55 PM; or whole hours."""
    text = str(value).strip().removesuffix(".0")
    if text.isdecimal() and len(text) <= 4:
        text = f"{text}00" if hours and len(text) < 3 else text
        text = f"{text.zfill(4)[:2]}:{text.zfill(4)[2:]}"
    match = re.fullmatch(rf"\s*{_CLOCK}\s*(Z|UTC|GMT)?\s*", text, re.IGNORECASE)
    if match is None:
        raise ValueError(text)
    return _clock(match.groupdict())


def at_midnight(date: datetime) -> bool:
    """Returns whether a date has no time of day, or midnight."""
    return isinstance(date, Date) or date.time() == time()


def in_utc(date: datetime) -> datetime:
    """Returns the time in UTC. A time without a zone is taken as UTC."""
    return date.astimezone(UTC) if date.tzinfo else date.replace(tzinfo=UTC)


def _readers(texts: Sequence[str], form: str | None) -> dict[str, Callable[[str], datetime]]:
    """Returns the ways to read texts, by the value of `fire.time_format` that chooses each."""

    def pattern(text: str, form: str) -> datetime:
        kind = datetime if re.search("%[HIXcRT]", form) else Date
        return kind.strptime(text, form)

    def since_1970(text: str, scale: int) -> datetime:
        return datetime.fromtimestamp(float(text) / scale, UTC)

    known: dict[str, Callable[[str], datetime]] = {
        "seconds": lambda text: since_1970(text, 1),
        "milliseconds": lambda text: since_1970(text, 1000),
        "%y%m%d%H%M": lambda text: pattern(text, "%y%m%d%H%M"),
        "%Y%m%d%H": lambda text: pattern(text, "%Y%m%d%H"),
        **{
            name: lambda text, order=order: _written(text, order) for name, order in _ORDERS.items()
        },
    }
    if form is not None:
        if form not in known and "%" not in form:
            raise UserError(f"fire.time_format={form}: expected {', '.join(known)}, or such")
        return {form: known.get(form, lambda text: pattern(text, form))}
    lengths = {len(text) for text in texts if text.isdecimal()} | {not t.isdecimal() for t in texts}
    if lengths == {10, False}:
        return {name: known[name] for name in ("seconds", "%y%m%d%H%M", "%Y%m%d%H")}
    if lengths == {13, False} or (lengths == {12, False} and not all(map(is_date, texts))):
        return {"milliseconds": known["milliseconds"]}
    return {name: known[name] for name in _ORDERS}


def _written(text: str, order: str) -> datetime:
    """Reads a text of one of the forms."""
    matches = (re.fullmatch(form, text, re.IGNORECASE) for form in _FORMS)
    match = next((match for match in matches if match), None)
    if match is None:
        raise ValueError(text)
    part = match.groupdict()
    if "a" in part:
        part |= dict(zip(order, (part["a"], part["b"], part["c"]), strict=True))
        if len(part["Y"]) < len(part["c"]):
            raise ValueError(text)  # year_first
    year = int(part["Y"]) + (2000 if len(part["Y"]) <= 2 else 0)
    if part.get("J"):
        day = datetime.strptime(f"{year} {part['J']}", "%Y %j")
    else:
        name = part.get("name")
        month = _MONTHS.index(name[:3].lower()) + 1 if name else int(part["M"])
        day = datetime(year, month, int(part["D"]))
    if part.get("h") is None:
        return Date(day.year, day.month, day.day)
    zone, offset = part.get("zone"), part.get("offset")
    shift = timedelta(hours=_ZONES[zone.upper()] if zone else 0)
    if offset:
        digits = offset[1:].replace(":", "")
        away = timedelta(hours=int(digits[:2]), minutes=int(digits[2:] or 0))
        shift += -away if offset[0] == "-" else away
    return (day + _clock(part)).replace(tzinfo=timezone(shift) if zone or offset else None)


def _clock(part: dict[str, Any]) -> timedelta:
    hour, half = int(part["h"]), (part.get("half") or "")[:1].lower()
    minute, second = (int(part.get(k) or part.get(k + "2") or part.get(k + "3") or 0) for k in "ms")
    if minute > 59 or second > 59 or not (1 <= hour <= 12 if half else hour <= 23):
        raise ValueError(part)
    hour = hour % 12 + 12 * (half == "p") if half else hour
    return timedelta(hours=hour, minutes=minute, seconds=second)
