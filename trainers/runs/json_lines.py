"""Reads, appends to and truncates the .jsonl files of a run folder."""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from emberlink.envs.utils import atomic_io
from emberlink.envs.utils.errors import UserError
from emberlink.trainers.runs.safe_read import MAX_JSON, parse_json, read_text


class JsonLines:
    """The .jsonl files of a folder, such as metrics.jsonl with one line per episode.

    Args:
        path: the folder.
    """

    def __init__(self, path: Path | str):
        self.path = Path(path)

    def lines(self, file: str = "metrics.jsonl") -> list[dict[str, Any]]:
        """Returns the lines of a file; an empty list if there is no such file.

        An incomplete last line, which a killed process left, is ignored.

        Raises:
            UserError: a line is not of the form {"episode": 1, NAME: NUMBER, ...}.
        """
        path = self.path / file
        text = read_text(path, MAX_JSON) if path.exists() else ""
        complete = text[: text.rfind("\n") + 1].splitlines()
        try:
            return [_numbers(line) for line in complete]
        except ValueError as error:
            raise UserError(f"{path}: not a file of JSON lines: {error}") from None

    def append(self, file: str, line: Mapping[str, Any]) -> None:
        """Appends a line to a file, completely or not at all.

        Raises:
            UserError: it cannot be written, such as to a full disk.
        """
        path = self.path / file
        try:
            with atomic_io.open_in_place(path, create=True) as handle:
                before = os.fstat(handle).st_size
                left = (json.dumps(line) + "\n").encode()
                try:
                    while left:
                        left = left[os.write(handle, left) :]
                except OSError:
                    os.ftruncate(handle, before)
                    raise
        except OSError as error:
            raise UserError(f"{path}: cannot be written: {error.strerror}") from None

    def size(self, file: str) -> int:
        """Flushes a file to the disk and returns its size in bytes; 0 if there is no such file.

        Raises:
            UserError: it cannot be read.
        """
        path = self.path / file
        try:
            with atomic_io.open_regular(path, MAX_JSON) as content:
                os.fsync(content.fileno())
                return os.fstat(content.fileno()).st_size
        except FileNotFoundError:
            return 0
        except OSError as error:
            raise UserError(f"{path}: cannot be read: {error.strerror or error}") from None

    def check_lines(self, file: str, size: int, lines: int) -> None:
        """Checks that the first bytes of a file are those that it had at a checkpoint.

        Args:
            file: name of the file; a link is refused, because a resumed run appends to the file.
            size: size of the file at the checkpoint, bytes.
            lines: number of lines at the checkpoint.

        Raises:
            UserError: the file is a link, is not regular, is shorter, or has another number of
                lines.
        """
        path = self.path / file
        try:
            kept = atomic_io.read_bytes(path, MAX_JSON, follow=False)[:size]
        except FileNotFoundError:
            kept = b""
        except OSError as error:
            raise UserError(f"{path}: cannot be read: {error.strerror}") from None
        complete = not kept or kept.endswith(b"\n")
        if len(kept) < size or not complete or kept.count(b"\n") != lines:
            raise UserError(
                f"{path}: had {lines} lines in {size} bytes at the checkpoint; its first "
                f"{len(kept)} bytes differ"
            )

    def cut(self, file: str, size: int) -> None:
        """Truncates a file to `size` bytes if it is larger.

        Raises:
            UserError: it is a link, is not regular, or cannot be written.
        """
        path = self.path / file
        try:
            with atomic_io.open_in_place(path) as handle:
                if os.fstat(handle).st_size > size:
                    os.ftruncate(handle, size)
        except FileNotFoundError:
            return
        except OSError as error:
            raise UserError(f"{path}: cannot be cut: {error.strerror}") from None


def _numbers(line: str) -> dict[str, Any]:
    """Returns the numbers of a line by name."""
    value = parse_json(line)
    if not isinstance(value, dict) or "episode" not in value:
        raise UserError("a line is not of the form {episode: ..., ...}")
    if not all(isinstance(number, int | float) for number in value.values()):
        raise UserError("a line holds a value that is not a number")
    return value
