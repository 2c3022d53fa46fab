"""When perimeters were: elapsed or calendar time, from the columns that people use for it."""

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np

from emberlink.envs.utils.errors import UserError

from .arrival_raster import Clock, Units

ELAPSED: dict[str, Units] = {
    "elapsed_mi": "minutes",
    "elapsed_min": "minutes",
    "elapsed_minutes": "minutes",
    "minutes": "minutes",
    "elapsed_s": "seconds",
    "seconds": "seconds",
    "elapsed_hours": "hours",
    "hours": "hours",
    "days": "days",
}
"""columns of elapsed time, in lower case, whose name says the unit"""
CALENDAR = (
    *("poly_polygondatetime", "polygondatetime", "perimeterdatetime", "perdatetime", "perdattime"),
    *("gdb_from_date", "poly_datecurrent", "datecurrent"),
    *("datetime", "date_time", "timestamp", "acq_datetime", "acq_time", "acq_date"),
    *("date_", "date", "time", "t"),
)
"""columns of calendar time, in lower case: when a perimeter was mapped, before when its record was
changed"""
_DBF = 10  # letters of a column's name that a .dbf keeps
_EPOCH_MS = 1e11  # numbers above it are milliseconds since 1970: 1973 and later
_LATEST_MS = 2.5e14  # in the year 9892
_LATEST = 1e12
_WRITTEN = {8: "%Y%m%d", 12: "%Y%m%d%H%M", 14: "%Y%m%d%H%M%S"}
"""dates as numbers of so many digits"""


@dataclass(frozen=True)
class Times:
    """Of the features of a file."""

    values: np.ndarray
    """float64 [features]"""
    clock: Clock


def perimeter_times(frame: Any, wanted: str | None, unit: Units | None) -> Times:
    """The time of each feature.

    Args:
        frame: a table with a column per attribute.
        wanted: `fire.time_field`; None to look for a column that is known.
        unit: `fire.units`.

    Raises:
        ValueError: no column, several, or a value that is no time; one line that names it.
    """
    names = [str(name) for name in frame.columns if name != frame.geometry.name]
    lower = {name.lower(): name for name in names}
    if wanted is not None:
        if wanted not in names and wanted.lower() not in lower:
            raise UserError(f"no column {wanted!r} (fire.time_field); there are {_listed(names)}")
        name = wanted if wanted in names else lower[wanted.lower()]
        return _column(frame, name, unit)
    for known in (*ELAPSED, *(one for name in CALENDAR for one in (name, name[:_DBF]))):
        if known in lower:
            return _column(frame, lower[known], unit)
    if {"month", "day", "hour"} <= set(lower):
        return _farsite(frame, lower)
    dates = [name for name in names if _all_dates(frame[name])]
    if len(dates) == 1:
        return _column(frame, dates[0], unit)
    raise UserError(
        f"which column holds the times is not known; expected fire.time_field, one of "
        f"{_listed(names)}"
    )


def _listed(names: list[str]) -> str:
    return ", ".join(names[:30]) or "none"


def _column(frame: Any, name: str, unit: Units | None) -> Times:
    column = frame[name]
    empty = np.flatnonzero(column.isna().to_numpy())
    if len(empty):
        raise UserError(f"feature {empty[0]} has no time in {name}; expected one in each")
    if column.dtype.kind in "iuf":
        return _numbers(column.to_numpy(dtype=np.float64), name, unit)
    values = [str(value).strip() for value in column]
    try:
        numbers = np.array([float(value) for value in values])
    except ValueError:
        return _calendar([_parsed(v, i, name) for i, v in enumerate(values)], name)
    return _numbers(numbers, name, unit)


def _numbers(values: np.ndarray, name: str, unit: Units | None) -> Times:
    """Elapsed time, or milliseconds since 1970, as ESRI's services give dates."""
    wrong = np.flatnonzero(~np.isfinite(values) | (values < 0))
    if len(wrong):
        raise UserError(
            f"feature {wrong[0]} has {name}={values[wrong[0]]:g}; expected a time of 0 or more"
        )
    if name.lower() not in ELAPSED and (form := _date_form(values)):
        return _calendar([_written(v, form, i, name) for i, v in enumerate(values)], name)
    if (values > _EPOCH_MS).all() and name.lower() not in ELAPSED:
        if values.max() > _LATEST_MS:
            raise UserError(f"{name}={values.max():g} is no time; expected milliseconds since 1970")
        return _calendar([datetime.fromtimestamp(value / 1000, UTC) for value in values], name)
    if values.max() > _LATEST:
        raise UserError(f"{name}={values.max():g} is no time; expected less than {_LATEST:g}")
    said = ELAPSED.get(name.lower())
    if said and unit and unit != said:
        raise UserError(f"{name} is in {said}; expected fire.units={said}, not {unit}")
    if not (said or unit):
        raise UserError(
            f"{name} does not say in what its times are: expected fire.units=minutes, seconds, "
            "hours, days or steps"
        )
    return Times(values, Clock(said or unit or "minutes"))


def _date_form(values: np.ndarray) -> str:
    """How numbers such as 20200819, 202008191300 or 20200819130000 are written; "" if not so."""
    if (values != np.floor(values)).any():
        return ""
    for digits, form in _WRITTEN.items():
        year, rest = np.divmod(values, 10.0 ** (digits - 4))
        month = rest // 10.0 ** (digits - 6)
        if ((year >= 1900) & (year <= 2100) & (month >= 1) & (month <= 12)).all():
            return form
    return ""


def _written(value: float, form: str, feature: int, name: str) -> datetime:
    try:
        return datetime.strptime(f"{value:.0f}", form)
    except ValueError:
        raise UserError(
            f"feature {feature} has {name}={value:.0f}, which is no date as others in it are; "
            "expected such as 20200819"
        ) from None


def _calendar(moments: list[datetime], name: str) -> Times:
    """Minutes since the first."""
    aware = [moment.tzinfo is not None for moment in moments]
    if any(aware) and not all(aware):
        raise UserError(
            f"{name}: feature {aware.index(True)} has a time zone and feature "
            f"{aware.index(False)} has none; expected all or none"
        )
    try:
        moments = [m.astimezone(UTC) if m.tzinfo else m.replace(tzinfo=UTC) for m in moments]
    except OverflowError:
        raise UserError(f"{name} has a time before year 1 or after 9999") from None
    first = min(moments)
    values = [(moment - first) / timedelta(minutes=1) for moment in moments]
    return Times(np.array(values), Clock("minutes", first))


def _all_dates(column: Any) -> bool:
    """Whether a column of text holds nothing but calendar times."""
    if column.dtype.kind in "iufb":
        return False
    try:
        return bool([parse_time(str(value)) for value in column])
    except ValueError:
        return False


def _parsed(text: str, feature: int, name: str) -> datetime:
    """ISO 8601, with the slashes and short zones of GDAL's own text too."""
    try:
        return parse_time(text)
    except ValueError:
        raise UserError(
            f"feature {feature} has {name}={text[:40]!r}; expected such as 2020-08-19T13:00"
        ) from None


def parse_time(text: str) -> datetime:
    """Calendar time from ISO text.

    Raises:
        ValueError: it is none.
    """
    text = text.strip().replace("/", "-")
    if len(text) > 40:
        raise UserError(f"{text[:40]!r} is no calendar time")
    return datetime.fromisoformat(text)


def _farsite(frame: Any, lower: dict[str, str]) -> Times:
    """FARSITE's columns Month, Day and Hour (1300 is 13:00), which say no year."""
    parts = [_whole_numbers(frame, lower[key]) for key in ("month", "day", "hour")]
    # From December to January the year changes; a fire does not last for half a year.
    over = bool((parts[0] >= 11).any() and (parts[0] <= 2).any())
    moments: list[datetime] = []
    for feature, (month, day, hour) in enumerate(zip(*parts, strict=True)):
        year = 2005 if over and month <= 6 else 2004
        try:
            minutes = 60 * (int(hour) // 100) + int(hour) % 100
            if not 0 <= minutes <= 24 * 60 or int(hour) % 100 > 59:
                raise ValueError
            moments.append(datetime(year, int(month), int(day)) + timedelta(minutes=minutes))
        except (ValueError, OverflowError):
            raise UserError(
                f"feature {feature} has Month={month:g}, Day={day:g}, Hour={hour:g}; expected a "
                "date and a time such as 1300"
            ) from None
    return _calendar(moments, "Month, Day, Hour")


def _whole_numbers(frame: Any, name: str) -> np.ndarray:
    values: list[float] = []
    for feature, value in enumerate(frame[name]):
        try:
            values.append(int(float(value)))
        except (TypeError, ValueError, OverflowError):
            raise UserError(
                f"feature {feature} has {name}={str(value)[:40]}; expected a whole number"
            ) from None
    return np.array(values, np.float64)
