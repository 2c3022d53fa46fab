"""Checks and reads the small files that the libraries open beside a file."""

import os
from pathlib import Path

from emberlink.envs.utils.atomic_io import read_bytes
from emberlink.envs.utils.errors import UserError

_SUFFIXES = (".prj", ".cpg", ".aux.xml", ".msk", ".ovr")
_MAX_BYTES = 1_000_000  # of a .prj


def check_sidecars(path: Path) -> None:
    """Checks that the files beside a file are regular. A pipe would block for ever.

    Raises:
        UserError: one is a pipe, a folder, a device or a broken link.
    """
    for suffix in _SUFFIXES:
        for ending in (suffix, suffix.upper()):
            for part in (path.with_suffix(ending), path.with_name(path.name + ending)):
                if os.path.lexists(part) and not part.is_file():
                    raise UserError(f"{part.name}, beside it, is no regular file")


def read_sidecar(path: Path) -> str:
    """Returns the text of a file beside another one.

    Raises:
        UserError: it cannot be read, is not regular, or is too large.
        UnicodeDecodeError: it is not UTF-8.
    """
    try:
        return read_bytes(path, _MAX_BYTES).decode("utf-8")
    except OSError as error:
        raise UserError(f"{path.name}, beside it: {error.strerror or error}") from None
