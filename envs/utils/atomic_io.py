"""Reads files of bounded size, and writes files completely or not at all."""

import errno
import os
import stat
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import BinaryIO

from emberlink.envs.utils.errors import UserError, shown


def user_path(path: os.PathLike[str] | str) -> Path:
    """Returns a path that the user gave, with the home folder for `~`."""
    try:
        return Path(path).expanduser()
    except RuntimeError:
        raise UserError(
            f"{shown(path)}: there is no such home folder; the variable HOME names yours"
        ) from None


def open_regular(path: Path, max_bytes: int) -> BinaryIO:
    """Opens a regular file, or the target of a link; an OSError if it is not one or too large."""
    # A pipe or a device would block, or change when it is opened.
    handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    about, why = os.fstat(handle), None
    if not stat.S_ISREG(about.st_mode):
        why = errno.EINVAL, "it is not a regular file"
    elif about.st_size > max_bytes:
        why = errno.EFBIG, f"it has more than {max_bytes} bytes"
    if why:
        os.close(handle)
        raise OSError(*why, str(path))
    return os.fdopen(handle, "rb")


def read_bytes(path: Path, max_bytes: int) -> bytes:
    """Returns the content of a regular file; raises the errors of `open_regular`."""
    with open_regular(path, max_bytes) as file:
        return file.read(max_bytes)


@contextmanager
def replaced(path: Path) -> Iterator[Path]:
    """Yields a new empty file, which is renamed to `path` when the block ends without an error."""
    # The process number distinguishes processes that write to the same folder.
    partial = path.with_name(f"{path.name}.{os.getpid()}.part")
    partial.unlink(missing_ok=True)
    try:
        partial.touch(exist_ok=False)
        yield partial
        sync(partial)
        partial.replace(path)
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)
    with suppress(OSError):  # not all file systems can flush a folder
        sync(path.parent)


def write_bytes(path: Path, content: bytes | memoryview) -> None:
    """Writes a file completely, or leaves the earlier one; see `replaced`."""
    with replaced(path) as partial:
        partial.write_bytes(content)


@contextmanager
def created(path: Path) -> Iterator[Path]:
    """Yields a new empty file, which is renamed to `path` of `new_file` or `free_name`."""
    try:
        with replaced(path) as partial:
            yield partial
    except OSError as error:
        raise UserError(f"{shown(path)}: {error.strerror or error}") from None


def new_file(output: Path, suffixes: Sequence[str]) -> Path:
    """Checks that a file with one of the suffixes can be created, and returns its path."""
    output = user_path(output)
    if output.suffix not in suffixes:
        raise UserError(f"{shown(output)}: the file's name must end in {' or '.join(suffixes)}")
    if os.path.lexists(output):
        raise UserError(f"{output} exists already; nothing is overwritten")
    if not output.parent.is_dir():
        raise UserError(f"{shown(output.parent)}: there is no such folder")
    return output


def free_name(folder: Path, stem: str, suffixes: Sequence[str]) -> Path:
    """Returns the first of `stem`, `stem_2`, ... that no file has yet with one of the suffixes."""
    for attempt in count(1):
        name = folder / (stem if attempt == 1 else f"{stem}_{attempt}")
        if not any(os.path.lexists(f"{name}{suffix}") for suffix in suffixes):
            return name
    raise AssertionError


def sync(path: Path) -> None:
    """Flushes a file, or the list of names in a folder, to the disk."""
    handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
