"""The one door for fire files: finds the format and refuses what could harm, before GDAL opens it.

A path is local, regular and of bounded size, and so are the files that GDAL would open beside it.
The driver follows from the first bytes, so that no text in a file can choose another one.
"""

import hashlib
import importlib
import logging
import re
import sqlite3
import struct
import warnings
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from emberlink.envs.fire_files.report import ask
from emberlink.envs.utils.errors import UserError, how_to_install

MAX_BYTES = 300_000_000
"""Bytes of a text file; half as many of GeoJSON, which takes more memory while it is parsed."""
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
_SUFFIXES = (".shp", ".gpkg", ".geojson", ".json", ".kml", ".kmz", ".csv")
_BESIDE = {
    "shp": (".shx", ".dbf", ".prj", ".cpg"),
    "asc": (".prj",),
    "gpkg": ("-wal", "-journal"),
    "tif": (".aux.xml", ".msk", ".ovr", ".aux", ".prj", ".tfw", ".tifw", ".tiffw", ".wld", ".tab"),
}
"""Endings of the files that the libraries open beside one."""


def library(name: str, what: str = "reading this file") -> Any:
    """Imports a module of the extra `geo`, which `what` needs."""
    try:
        return importlib.import_module(name)
    except ImportError:
        how = how_to_install("geo")
        raise UserError(f"{what} needs the extra geo: {how} ({name} is missing)") from None


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
        return "grids" if forest_grids(path) else "folder"
    kind, head, size = _look(path)
    if not kind or (kind == "kmz" and path.suffix.lower() != ".kmz"):
        seen = "an archive" if kind else f"begins with {head[:16]!r}" if head else "is empty"
        known = "GeoTIFF, NetCDF, ESRI ASCII, .npy, .shp, .gpkg, GeoJSON, KML, KMZ, CSV of points"
        raise ask(seen, f"{known}, the paper's text")
    if path in forest_grids(path.parent):
        raise ask("one map of Cell2Fire", "its folder")
    most = MAX_BYTES // 2 if kind == "json" else MAX_BYTES
    if kind in ("asc", "csv", "kml", "points", "json") and size > most:
        raise ask(f"{size} bytes", f"a text file of at most {most}")
    parts = {part.suffix.lower(): part for part in (path, *beside(path, kind))}
    for suffix, part in parts.items():
        # GDAL opens masks and overviews in any format; some formats read other addresses.
        if _look(part)[0] != "tif" and suffix in (".msk", ".ovr"):
            raise ask(f"{part.name}, beside it, is no TIFF", "one, or no such file")
    for suffix in (".shp", ".shx", ".dbf") if kind == "shp" else ():
        if suffix not in parts:
            raise UserError(f"{path.with_suffix(suffix).name} is missing beside it")
        _, head, size = _look(parts[suffix])
        records, start, row = struct.unpack("<IHH", head.ljust(100, b"\0")[4:12])
        told = 2 * int.from_bytes(head[24:28]) if suffix != ".dbf" else start + records * row
        if not 0 < told <= size:
            raise ask(f"{parts[suffix].name} is damaged", f"{told} bytes or more")
    if kind == "gpkg":  # GDAL reads the rest of a file that was cut off
        try:
            uri = f"{path.absolute().as_uri()}?mode=ro&immutable=1"
            with closing(sqlite3.connect(uri, uri=True)) as database:
                result = str(database.execute("PRAGMA integrity_check(1)").fetchone()[0])
        except sqlite3.Error as error:
            result = str(error)
        if result != "ok":
            raise ask(result[:100], "a whole GeoPackage")
    return kind


def beside(path: Path, kind: str) -> list[Path]:
    """Returns the files that belong to a file, with its name and an ending, in any case."""
    endings = _BESIDE.get(kind, ())
    names = {f"{name}{ending}".lower() for name in (path.stem, path.name) for ending in endings}
    return sorted(part for part in path.parent.iterdir() if part.name.lower() in names)


def check_prj(path: Path, kind: str, crs: Any) -> None:
    """Checks that the projection in a .prj beside a file was understood, or given by a key."""
    for part in beside(path, kind) if crs is None else ():
        if part.suffix.lower() == ".prj" and part.stat().st_size:
            seen = f"{part.name}, beside it, holds no projection that is known"
            raise ask(seen, "fire.crs, such as fire.crs=EPSG:32611")


def forest_grids(folder: Path) -> list[Path]:
    """Returns the maps of Cell2Fire in a folder, in the order of their numbers."""
    found = [path for path in folder.glob("ForestGrid*.csv") if _look(path)]
    return sorted(found, key=lambda path: (len(path.name), path.name))


def perimeter_files(folder: Path) -> list[Path]:
    """Returns the perimeters in a folder, sorted by name."""
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in _SUFFIXES)
    if not 0 < len(paths) <= _MAX_FILES:
        seen = f"a folder with {len(paths)} files of perimeters ({', '.join(_SUFFIXES)})"
        raise ask(seen, f"a file, or a folder of up to {_MAX_FILES} of one fire")
    return paths


def digest(path: Path) -> str:
    """Returns the SHA-256 of a file and the files beside it, or of a folder's fires."""
    content, folder = hashlib.sha256(), path.is_dir()
    for main in (forest_grids(path) or perimeter_files(path)) if folder else [path]:
        for part in (main, *beside(main, _look(main)[0])):
            name = part.name if folder else part.name[len(path.stem) :]
            content.update(f"{name}:{_look(part)[2]}:".encode())
            with part.open("rb") as file:
                while block := file.read(1 << 20):
                    content.update(block)
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
