"""What is said about a file: what was understood, doubts, questions, and times as text."""

from dataclasses import dataclass, field
from datetime import datetime, timedelta

from emberlink.envs.utils.errors import UserError

SECONDS = {"seconds": 1, "minutes": 60, "hours": 3600, "days": 86400, "day_of_year": 86400}


@dataclass
class Report:
    """Collects what was understood of a file while it is read."""

    facts: list[str] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Clock:
    """The unit of a file's times, and the calendar time of 0, in UTC, where it is known."""

    unit: str
    """A unit of `SECONDS`, `steps`, or `maps` of an array of states."""
    origin: datetime | None = None

    def format(self, time: float) -> str:
        """Returns a time as text."""
        if self.origin is None or abs(time * SECONDS[self.unit]) > 1e10:
            text = f"{time:g}" if abs(time) < 1e4 else f"{time:.10g}"
            return f"{text} {self.unit}".replace("day_of_year", "days")
        date = self.origin + timedelta(seconds=time * SECONDS[self.unit])
        return date.isoformat(timespec="minutes")

    def beginning(self, first: float, last: float) -> float:
        """Returns when a fire began: elapsed times are counted from there; asks if unsure."""
        if self.origin is not None or self.unit not in ("seconds", "minutes", "hours", "days"):
            return first
        if first > last - first > 0:
            seen = f"times from {self.format(first)} to {self.format(last)}"
            raise ask(seen, "fire.start=0 if it began at 0", f"fire.start={first:.12g} if then")
        return 0.0


def ask(seen: str, *answers: str) -> UserError:
    """Returns a question: what was seen, and what is expected, such as the keys that decide."""
    return UserError(f"{seen}; expected {', or '.join(answers)}")
