"""Reads and writes the folder of a sweep of worlds: settings, results, figure."""

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from emberlink.envs.utils import atomic_io
from emberlink.envs.utils.errors import UserError
from emberlink.trainers.config.values import flat
from emberlink.trainers.runs import compact_json
from emberlink.trainers.runs.json_lines import JsonLines
from emberlink.trainers.runs.lock import Lock
from emberlink.trainers.runs.safe_read import MAX_JSON, parse_json, read_text
from emberlink.trainers.worlds.axes import World

Line = dict[str, Any]
_NEEDED = {*World._fields, "headline", "gain", "gain_all"}
_SETTINGS, _LINES, FIGURE = "sweep.json", "worlds.jsonl", "sweep.png"


class SweepFolder:
    """The files of a sweep: sweep.json, worlds.jsonl and sweep.png.

    Args:
        path: a new or empty folder, or that of a sweep with the same settings.
        settings: all that the results depend on, plain values.

    Raises:
        UserError: the folder is of another sweep or of something else, cannot be written, or
            another process writes to it.
    """

    def __init__(self, path: Path, settings: Mapping[str, Any]):
        self.path = path
        try:
            path.mkdir(parents=True, exist_ok=True)
            empty = not any(name != "lock" for name in os.listdir(path))
        except OSError as error:
            raise UserError(f"{path}: cannot be used: {error.strerror or error}") from None
        self._lock = Lock(path, "sweeping")
        try:
            if empty:
                text = compact_json.dumps(dict(settings)) + "\n"
                atomic_io.write_bytes(path / _SETTINGS, text.encode())
            self._check(settings)
            self.lines = self._read_lines()
        except OSError as error:
            self._lock.release()
            raise UserError(f"{path}: cannot be used: {error.strerror or error}") from None
        except BaseException:
            self._lock.release()
            raise

    def __enter__(self) -> "SweepFolder":
        return self

    def __exit__(self, *_: object) -> None:
        self._lock.release()

    def append(self, world: World, line: Line) -> None:
        """Adds the line of a world to worlds.jsonl, completely or not at all."""
        JsonLines(self.path).append(_LINES, line)
        self.lines[world] = line

    @contextmanager
    def figure(self) -> Iterator[Path]:
        """Yields a path for a figure, which is renamed to sweep.png at the end."""
        path = self.path / FIGURE
        try:
            with atomic_io.replaced(path) as partial:
                yield partial
        except OSError as error:
            raise UserError(f"{path}: cannot be written: {error.strerror or error}") from None

    def _check(self, settings: Mapping[str, Any]) -> None:
        """Checks that the folder has the settings of this sweep."""
        path = self.path / _SETTINGS
        try:
            stored = parse_json(read_text(path, MAX_JSON))
        except FileNotFoundError:
            raise UserError(f"{self.path}: not empty, and not the folder of a sweep") from None
        except ValueError as error:
            raise UserError(f"{path}: cannot be read: {error}") from None
        before = flat(stored) if isinstance(stored, dict) else {}
        now = flat(compact_json.finite(settings))
        other = [key for key in {**now, **before} if now.get(key) != before.get(key)]
        if other:
            raise UserError(
                f"{self.path}: holds a sweep with other settings ({', '.join(other[:5])}); "
                "choose another folder"
            )

    def _read_lines(self) -> dict[World, Line]:
        """Returns the lines of worlds.jsonl; removes an incomplete last one."""
        path = self.path / _LINES
        try:
            text = read_text(path, MAX_JSON)
        except FileNotFoundError:
            return {}
        complete = text[: text.rfind("\n") + 1]
        lines = {}
        for number, content in enumerate(complete.splitlines(), 1):
            try:
                line = parse_json(content)
                if not set(line) >= _NEEDED or not _has_numbers(line):
                    raise KeyError(number)
                lines[World(**{name: line[name] for name in World._fields})] = line
            except (ValueError, KeyError, TypeError):
                raise UserError(f"{path}: line {number} is not of a sweep of worlds") from None
        JsonLines(self.path).cut(_LINES, len(complete.encode()))
        return lines


def _has_numbers(line: Line) -> bool:
    """Returns whether a line has its gains with errors, and the means of four policies."""
    parts = [line[key] for key in ("gain", "gain_all", "headline")]
    numbers = all(isinstance(number, int | float) for part in parts for number in part)
    return numbers and [*map(len, parts)] == [2, 2, 4]
