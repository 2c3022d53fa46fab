"""Writes new files without replacing existing ones."""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from emberlink.envs.utils.atomic_io import link_new, sync, temporary
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import shown


@contextmanager
def published(path: Path) -> Iterator[Path]:
    """Yields a new empty file, which is renamed to `path` when the block ends without an error.

    Args:
        path: path of the new file.

    Raises:
        UserError: the path exists, or the file cannot be written, such as to a full disk. No
            partial file is left.
    """
    try:
        with temporary(path) as partial:
            yield partial
            sync(partial)
            link_new(partial, path)
    except FileExistsError:
        raise UserError(f"{path} exists already; nothing is overwritten") from None
    except OSError as error:
        raise UserError(f"{shown(str(path))}: {error.strerror or error}") from None


def new_file(output: Path, suffixes: Sequence[str]) -> Path:
    """Checks that a file can be created at a path that the user gave, and returns the path.

    Args:
        output: the path.
        suffixes: accepted suffixes.

    Raises:
        UserError: the path exists, has another suffix, or is in a folder that does not exist.
    """
    if os.path.isdir(output):
        raise UserError(f"{output} is a folder; a file ends in {', '.join(suffixes)}")
    if output.suffix not in suffixes:
        raise UserError(
            f"{shown(str(output))}: the file's name must end in {' or '.join(suffixes)}"
        )
    if os.path.lexists(output):
        raise UserError(f"{output} exists already; nothing is overwritten")
    if not os.path.isdir(output.parent):
        raise UserError(f"{shown(str(output.parent))}: there is no such folder")
    return output


def free_name(folder: Path, stem: str, suffixes: Sequence[str]) -> Path:
    """Returns the first of the paths `stem`, `stem_2`, ... that no file has yet, without a suffix.

    Args:
        folder: folder of the files.
        stem: first name to try.
        suffixes: suffixes of the files that will have this name.

    Raises:
        UserError: 9999 names are taken.
    """
    for attempt in range(1, 10_000):
        name = folder / (stem if attempt == 1 else f"{stem}_{attempt}")
        if not any(os.path.lexists(f"{name}{suffix}") for suffix in suffixes):
            return name
    raise UserError(f"{folder}: {stem} and 9998 more exist already")
