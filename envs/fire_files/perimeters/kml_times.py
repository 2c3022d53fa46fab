"""Chooses the time of each placemark of KML, which may have several."""

from typing import Any

from emberlink.envs.fire_files.perimeters.times import CALENDAR, known_columns

_OWN = ("timestamp", "begin")  # GDAL's columns of TimeStamp and TimeSpan


def with_one_time(frame: Any) -> Any:
    """Returns the features of KML with one column of dates, `timestamp`.

    The date of a placemark is its TimeStamp, otherwise the begin of its TimeSpan, otherwise that in
    its ExtendedData. The table is returned as it is if no placemark has the first two, or if the
    ExtendedData of those without them has several columns of dates.
    """
    names = {str(name).lower(): str(name) for name in frame.columns}
    own = [names[name] for name in _OWN if name in names]
    if not own:
        return frame
    times = frame[own[0]]
    for name in own[1:]:
        times = times.where(times.notna(), frame[name])
    others = [name for name in known_columns(names, CALENDAR) if name not in own]
    if times.isna().any():
        filled = [name for name in others if frame.loc[times.isna(), name].notna().any()]
        if len(filled) > 1 or (filled and "time_" in names):
            return frame
        for name in filled:
            times = times.where(times.notna(), frame[name])
    return frame.drop(columns=[*own, *others]).assign(timestamp=times)
