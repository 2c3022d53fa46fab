"""Checks and reads the small files that the libraries open beside a file."""

import os
from collections.abc import Sequence
from pathlib import Path

from emberlink.envs.utils.atomic_io import read_bytes
from emberlink.envs.utils.errors import UserError

_GEOTIFF = (".aux.xml", ".msk", ".aux", ".tfw", ".tifw", ".tiffw", ".wld", ".tab")
_READ = {".tif": _GEOTIFF, ".tiff": _GEOTIFF, ".gpkg": ("-wal", "-journal")}
"""Endings of files that change what GDAL reads, besides those that `formats` knows."""
_OPENED = (".prj", ".cpg", ".ovr", *_GEOTIFF, "-wal", "-shm", "-journal")
_IMAGES = (".msk", ".ovr")
_TIFF = (b"II*\0", b"II+\0", b"MM\0*", b"MM\0+")
_MAX_BYTES = 1_000_000  # of a .prj


def check_sidecars(path: Path) -> None:
    """Checks that the files beside a file are regular, and that masks and overviews are TIFF.

    A pipe would block for ever. GDAL opens masks and overviews of any format; one in its XML format
    VRT can make it fetch from the network.

    Raises:
        UserError: one is a pipe, a folder, a device or a broken link, or of another format.
    """
    for part in _beside(path, _OPENED):
        if not part.is_file():
            raise UserError(f"{part.name}, beside it, is no regular file")
        if part.suffix.lower() in _IMAGES and not _begins_with(part, _TIFF):
            raise UserError(f"{part.name}, beside it, is no TIFF; expected one, or no such file")


def _begins_with(path: Path, heads: tuple[bytes, ...]) -> bool:
    with path.open("rb") as file:
        return file.read(4).startswith(heads)


def read_beside(path: Path) -> list[Path]:
    """Returns the files beside a raster or GeoPackage that change what GDAL reads, by name."""
    return [part for part in _beside(path, _READ.get(path.suffix.lower(), ())) if part.is_file()]


def _beside(path: Path, endings: Sequence[str]) -> list[Path]:
    """Returns what is beside a file with its name and an ending, in upper or lower case as in GDAL.

    The ending follows the name, or replaces its suffix.
    """
    names = {f"{name}{ending}" for name in (path.stem, path.name) for ending in endings}
    try:
        there = os.listdir(path.parent) if names else []
    except OSError:  # a folder that may be entered, but not listed
        both = {*names, *(path.stem + ending.upper() for ending in endings)}
        there = [name for name in both if os.path.lexists(path.with_name(name))]
    lower = {name.lower() for name in names}
    return sorted(path.with_name(name) for name in there if name.lower() in lower)


def read_sidecar(path: Path) -> str:
    """Returns the text of a file beside another one.

    Raises:
        UserError: it cannot be read, is not regular, or is too large.
        UnicodeDecodeError: it is not UTF-8.
    """
    try:
        return read_bytes(path, _MAX_BYTES).decode("utf-8-sig")
    except OSError as error:
        raise UserError(f"{path.name}, beside it: {error.strerror or error}") from None
