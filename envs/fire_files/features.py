"""Chooses the features of one fire: by a value of a column, and by incident."""

import re
from collections.abc import Sequence
from typing import Any

from emberlink.envs.fire_files.config import FileFireConfig
from emberlink.envs.utils.errors import UserError, unknown
from emberlink.envs.utils.validation import as_argument

_IDENTIFIER = re.compile(
    r"(poly|attr)?(incident|incid|fire|event|burn|complex|cluster|merged?)s?"
    r"(name|nm|id|num|number|no|nr|code)?|fname|.*irwin.*|.*uniquefire.*"
)
"""Columns that identify a fire, by the letters and digits of their names."""
_MAYBE = re.compile(r"name|id|num|number|label|(f|fire|ig|ignition|event)?(year|yr)")
"""Columns that may also number the features, or name their times."""
_CATEGORY = re.compile(r".*(category|class|kind|type|status)|(poly)?featu\w*|incidentty|type.*")


def plain(name: Any) -> str:
    """Returns the letters and digits of a column's name, in lower case."""
    return re.sub(r"[\W_]", "", str(name).lower())


def texts(column: Any) -> Any:
    """Returns the values of a column as texts; missing values are empty."""
    written = column.astype(str).fillna("")
    read = {text: re.sub(r"\.0$", "", text).strip() for text in written.unique()}
    return written.map(read).where(column.notna(), "")


def column_named(name: str, columns: Sequence[Any], key: str) -> Any:
    """Returns the column with a name in any case."""
    found = [column for column in columns if str(column).lower() == name.strip().lower()]
    if not found:
        known = ", ".join(map(str, columns[:30])) or "none"
        raise UserError(f"no column {name.strip()!r} ({key}); there are {known}")
    return found[0]


def choose_features(frame: Any, config: FileFireConfig, facts: list[str]) -> Any:
    """Returns the features of one fire; notes on the others are appended to `facts`."""
    for key, choose in (("where", _where), ("incident", _of_incident)):
        columns = [name for name in frame.columns if name != frame.geometry.name]
        kept = choose(frame, columns, config, facts)
        if len(kept) < len(frame):
            left_out = len(frame) - len(kept)
            facts.append(f"{left_out} left out by fire.{key}={getattr(config, key)}")
        frame = kept
    return frame


def _where(frame: Any, columns: Sequence[Any], config: FileFireConfig, _: list[str]) -> Any:
    """Returns the features that `fire.where` keeps; asks if a category has several values."""
    where = config.where
    if where is not None and where != "*":
        name, equals, pattern = where.partition("=")
        values = texts(frame[column := column_named(name, columns, "fire.where")])
        escaped = re.escape(pattern.strip()).replace(r"\*", ".*").replace(r"\|", "|")
        keeps = values.str.fullmatch(escaped, case=False) if equals else values != ""
        if not keeps.any():
            raise UserError(f"fire.where={where} keeps no feature; {_counts(frame, column)}")
        return frame[keeps]
    for column in columns if where is None else ():
        values, sure = texts(frame[column]), re.search("categ|featu", plain(column)) is not None
        if _CATEGORY.fullmatch(plain(column)) and 1 < values.nunique() < len(frame) + sure:
            choice = as_argument("fire.where", f"{column}={values.mode().iloc[0]}")
            raise UserError(
                f"features of several kinds: {_counts(frame, column)}; expected {choice}, or "
                "fire.where=* for all of them"
            )
    return frame


def _of_incident(
    frame: Any, columns: Sequence[Any], config: FileFireConfig, facts: list[str]
) -> Any:
    """Returns the features of `fire.incident`; asks if identifiers differ."""
    wanted, field = config.incident, config.incident_field
    if wanted == "*":
        return frame
    sure = [name for name in columns if _IDENTIFIER.fullmatch(plain(name))]
    known = [*sure, *(name for name in columns if _MAYBE.fullmatch(plain(name)))]
    place = None if field is None else column_named(field, columns, "fire.incident_field")
    if wanted is not None:
        name, places = wanted.strip().lower(), known if place is None else [place]
        found = [at for at in places if (texts(frame[at]).str.lower() == name).any()]
        if not found:
            values = {text for at in places for text in texts(frame[at]) if text}
            raise UserError(f"fire.incident={unknown(wanted, sorted(values)[:30])}")
        frame = frame[texts(frame[found[0]]).str.lower() == name]
        other = f"fire.incident_field={found[0]} beside fire.incident for all of these"
    else:
        sure, known = ([place], [place]) if place is not None else (sure, known)
        other = "fire.incident=* for all as one fire"
    counts = {name: texts(frame[name]).replace("", None).nunique() for name in known}
    several = [name for name, n in counts.items() if 1 < n < len(frame) + (name in sure)]
    listed = "; ".join(_counts(frame, name) for name in several)
    if wanted is not None and field is not None and several:
        facts.append(f"which differ in {listed}")
    elif several:
        values = texts(frame[several[0]])
        value = as_argument("fire.incident", values[values != ""].iloc[0])
        raise UserError(
            f"{len(frame)} features of several fires: {listed}; expected "
            f"fire.incident_field={several[0]} {value}, or {other}"
        )
    return frame


def _counts(frame: Any, column: Any) -> str:
    """Returns the values of a column with the number of features of each."""
    counts = texts(frame[column]).value_counts()
    shown = [f"{value or '(none)'} ({count})" for value, count in counts.head(12).items()]
    return f"{column}: {', '.join(shown)}{', ...' if len(counts) > 12 else ''}"
