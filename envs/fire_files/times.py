"""Units of time, calendar times as people write them, and the clock of a source."""

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from email.utils import parsedate_to_datetime
from typing import Literal

from emberlink.envs.utils.errors import UserError

Units = Literal["steps", "seconds", "minutes", "hours", "days"]
SECONDS = {"seconds": 1.0, "minutes": 60.0, "hours": 3600.0, "days": 86400.0}
_DIGITS = {8: "%Y%m%d", 12: "%Y%m%d%H%M", 14: "%Y%m%d%H%M%S"}
_AMERICAN = ("%m-%d-%Y", "%m-%d-%Y %H:%M", "%m-%d-%Y %H:%M:%S")
_AMERICAN += ("%m-%d-%Y %I:%M %p", "%m-%d-%Y %I:%M:%S %p")
_MAX_LENGTH = 40


@dataclass(frozen=True)
class Clock:
    """The unit of a source's times, and the calendar time of 0 where it is known."""

    unit: Units
    origin: datetime | None = None

    def format(self, time: float) -> str:
        """Returns a time as text for a message."""
        if self.origin is not None:
            try:
                date = self.origin + timedelta(seconds=time * SECONDS[self.unit])
                return date.isoformat(timespec="minutes")
            except OverflowError:  # not a year of four digits
                pass
        return f"{time:g} {self.unit}"


def parse_time(text: str) -> datetime:
    """Reads a calendar time.

    Known forms are ISO 8601 (also with slashes), digits such as 20200819, 202008191300 and
    20200819130000, RFC 2822 (`Fri, 13 Feb 2026 14:30:58 GMT`), and month first with slashes as in
    the USA (`8/19/2015 1:55:00 AM`).

    Raises:
        UserError: the text is none of these.
    """
    text = text.strip()
    if len(text) <= _MAX_LENGTH:
        if text.isdecimal() and len(text) in _DIGITS:
            return _parse(text, (_DIGITS[len(text)],))
        if "," in text:
            try:
                return parsedate_to_datetime(text)
            except (TypeError, ValueError):
                raise UserError(f"{text!r} is not a calendar time") from None
        try:
            return datetime.fromisoformat(text.replace("/", "-"))
        except ValueError:
            return _parse(text.replace("/", "-"), _AMERICAN)
    raise UserError(f"{text[:_MAX_LENGTH]!r} is not a calendar time")


def _parse(text: str, forms: tuple[str, ...]) -> datetime:
    for form in forms:
        try:
            return datetime.strptime(text, form)
        except ValueError:
            continue
    raise UserError(f"{text!r} is not a calendar time")


def in_utc(time: datetime) -> datetime:
    """Returns the time in UTC; one without a zone is taken for UTC.

    Raises:
        UserError: the time is before year 1 or after year 9999.
    """
    try:
        return time.astimezone(UTC) if time.tzinfo else time.replace(tzinfo=UTC)
    except OverflowError:
        raise UserError(f"{time.isoformat()} is before year 1 or after year 9999") from None
