"""New files: a name that is free, and content that is whole before it gets that name."""

import errno
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from emberlink.envs.utils.atomic_io import sync, temporary

from .errors import UserError
from .validation import shown

_NO_LINKS = {errno.EPERM, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.EMLINK}


@contextmanager
def published(path: Path) -> Iterator[Path]:
    """A file to write, which gets its name once it is whole and if nobody else took that.

    Args:
        path: the name; what is written goes to the path that this yields.

    Raises:
        ValueError: the name is taken, or the file cannot be written, such as to a full disk;
            nothing is left of it then.
    """
    try:
        with temporary(path) as partial:
            yield partial
            sync(partial)
            _take(partial, path)
    except FileExistsError:
        raise UserError(f"{path} is there already; nothing is overwritten") from None
    except OSError as error:
        raise UserError(f"{shown(str(path))}: {error.strerror or error}") from None


def _take(partial: Path, path: Path) -> None:
    """Gives a file its name, if that is free."""
    try:
        os.link(partial, path)
    except OSError as error:
        if error.errno not in _NO_LINKS:
            raise
        # Memory cards and some network drives have no links: the name is reserved instead.
        path.open("x").close()
        partial.replace(path)


def new_file(output: Path, suffixes: Sequence[str]) -> Path:
    """A named file that is to be written and is not there yet.

    Args:
        output: as the user gave it.
        suffixes: that it may end in.

    Raises:
        ValueError: it is there, ends otherwise, or its folder is not there.
    """
    if os.path.isdir(output):
        raise UserError(f"{output} is a folder; a file ends in {', '.join(suffixes)}")
    if output.suffix not in suffixes:
        raise UserError(
            f"{shown(str(output))}: the file's name must end in {' or '.join(suffixes)}"
        )
    if os.path.lexists(output):
        raise UserError(f"{output} is there already; nothing is overwritten")
    if not os.path.isdir(output.parent):
        raise UserError(f"{shown(str(output.parent))}: there is no such folder")
    return output


def free_name(folder: Path, stem: str, suffixes: Sequence[str]) -> Path:
    """A name in a folder, without suffix, under which none of the files is there yet.

    Raises:
        ValueError: thousands are taken.
    """
    for attempt in range(1, 10_000):
        name = folder / (stem if attempt == 1 else f"{stem}_{attempt}")
        if not any(os.path.lexists(f"{name}{suffix}") for suffix in suffixes):
            return name
    raise UserError(f"{folder}: {stem} and 9999 more are there already")
