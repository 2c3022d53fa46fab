"""The one door for fire files: finds the format and refuses what could harm, before GDAL opens it.

A path is local, regular and of bounded size, and so are the files that GDAL would open beside it.
The driver follows from the first bytes, so that no text in a file can choose another one.
"""

import hashlib
import importlib
import logging
import re
import struct
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from emberlink.envs.fire_files.report import ask
from emberlink.envs.utils.errors import UserError, missing

MAX_BYTES = 150_000_000
"""Bytes of a text that is parsed whole."""
_MAX_FILES = 500
_TEXT = rb"(?:\xef\xbb\xbf)?\s*"  # after a byte order mark
_HEADS = {
    "npy": rb"\x93NUMPY",
    "tif": rb"II[*+]\0|MM\0[*+]",
    "nc": rb"CDF|\x89HDF",
    "shp": rb"\0\0\x27\x0a",
    "gpkg": rb"SQLite format 3\0",
    "kmz": rb"PK\x03\x04",
    "asc": _TEXT + rb"(?i:ncols|nrows)\s",
    "json": _TEXT + rb"\{",
    "kml": _TEXT + rb"<",
    "csv": _TEXT + rb"(?:[\w\"]+,)*\"?(?i:latitude\"?,\"?longitude)\"?,",
    "points": rb"\s*?(?:\n|\Z)|(?:[-+.\deE \t\r]*,){2,}[-+.\deE \t\r]*(?:\n|\Z)",
}
"""First bytes of each format."""
TABLES = ("shp", "gpkg", "json", "kml", "kmz", "csv", "folder")
"""Formats of perimeters."""
_GRID = "ForestGrid"  # begins the names of Cell2Fire's maps
_SUFFIXES = (".shp", ".gpkg", ".geojson", ".json", ".kml", ".kmz", ".csv")
_BESIDE = ".shx .dbf .prj .cpg -wal -journal .aux.xml .msk .ovr .aux .tfw .tifw .tiffw .wld .tab"
"""Endings of the files that the libraries open beside one."""


def library(name: str, what: str = "reading this file") -> Any:
    """Imports a module of the extra `geo`, which `what` needs."""
    try:
        return importlib.import_module(name)
    except ImportError:
        raise missing(name, "geo", what) from None


@contextmanager
def quiet() -> Iterator[None]:
    """Silences the warnings and logs of the libraries. Damage is reported as an error instead."""
    before = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    try:
        with warnings.catch_warnings(action="ignore"), np.errstate(all="ignore"):
            yield
    finally:
        logging.disable(before)


def first_line(error: BaseException) -> str:
    """Returns the first line of a library's message, at most 200 characters of it."""
    error = error.__cause__ if error.__cause__ and "previous exception" in str(error) else error
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:200]


def find_format(path: Path) -> str:
    """Returns the format of a file or folder, and checks that it is safe and whole."""
    if path.is_dir():
        return "grids" if members(path)[0].name.startswith(_GRID) else "folder"
    kind, head, size = _look(path)
    if not kind:
        seen = f"begins with {head[:16]!r}" if head else "is empty"
        known = "GeoTIFF, NetCDF, ESRI ASCII, .npy, .shp, .gpkg, GeoJSON, KML, KMZ, CSV of points"
        raise ask(seen, f"{known}, the paper's text")
    if kind in ("csv", "kml", "points", "json") and size > MAX_BYTES:
        raise ask(f"{size} bytes", f"a text file of at most {MAX_BYTES}")
    parts = {part.suffix.lower(): part for part in (path, *_beside(path))}
    for suffix, part in parts.items():
        form, head, size = _look(part)
        # GDAL opens masks and overviews in any format; some formats read other addresses.
        if form != "tif" and suffix in (".msk", ".ovr"):
            raise ask(f"{part.name}, beside it, is no TIFF", "one, or no such file")
        if size < (told := _declared(form or suffix, head.ljust(100, b"\0"))):
            raise ask(f"{part.name} is damaged", f"{told} bytes or more")
    if kind == "shp" and (missing := {".shx", ".dbf"} - {*parts}):
        raise UserError(f"{path.stem}{min(missing)} is missing beside it")
    return kind


def _declared(kind: str, head: bytes) -> int:
    """Returns the bytes that the header of a file declares; GDAL reads what is left of less."""
    if kind == ".dbf":
        records, start, row = struct.unpack("<IHH", head[4:12])
        return start + records * row
    if kind == "gpkg":
        return int.from_bytes(head[16:18]) * int.from_bytes(head[28:32])
    return 2 * int.from_bytes(head[24:28]) if kind == "shp" else 0  # and .shx


def _beside(path: Path) -> list[Path]:
    """Returns the files that belong to a file, with its name and an ending, in any case."""
    names = {f"{name}{end}".lower() for name in (path.stem, path.name) for end in _BESIDE.split()}
    return sorted(part for part in path.parent.iterdir() if part.name.lower() in names)


def members(folder: Path) -> list[Path]:
    """Returns the maps of Cell2Fire in a folder, in the order of their numbers, or perimeters."""
    paths = [path for path in folder.iterdir() if path.suffix.lower() in _SUFFIXES]
    paths = [path for path in paths if path.name.startswith(_GRID)] or paths
    if not 0 < len(paths) <= _MAX_FILES:
        raise ask(f"a folder with {len(paths)} files of perimeters", f"1 to {_MAX_FILES}")
    return sorted(paths, key=lambda path: (len(path.name), path.name))


def digest(path: Path) -> str:
    """Returns the SHA-256 of a file and the files beside it, or of a folder's fires."""
    content = hashlib.sha256()
    for main in members(path) if path.is_dir() else [path]:
        for part in (main, *_beside(main)):
            content.update(f"{part.name.removeprefix(path.stem)}:{_look(part)[2]}:".encode())
            with part.open("rb") as file:
                hashlib.file_digest(file, lambda: content)
    return content.hexdigest()


def _look(path: Path) -> tuple[str, bytes, int]:
    """Returns the format, empty if none is known, the first bytes and the size of a file."""
    if not path.exists():
        raise UserError(f"{path.name}: there is no such file")
    if not path.is_file():  # a pipe, for example, would block for ever
        raise UserError(f"{path.name}: no regular file")
    with path.open("rb") as file:
        head = file.read(4096)
    kind = next((k for k, start in _HEADS.items() if head and re.match(start, head)), "")
    return kind, head, path.stat().st_size
