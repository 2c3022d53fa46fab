"""The one door for fire files: finds the format and refuses what could harm, before GDAL opens it.

A path is local, regular and of bounded size, and so are the files that GDAL would open beside it.
The driver follows from the first bytes, so that no text in a file can choose another one.
"""

import hashlib
import re
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from emberlink.envs.fire_files.report import ask
from emberlink.envs.utils.atomic_io import open_regular, user_path
from emberlink.envs.utils.errors import UserError, printable, require

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
GRIDS = "ForestGrid"  # begins the names of Cell2Fire's maps
_SUFFIXES = (".shp", ".gpkg", ".geojson", ".json", ".kml", ".kmz", ".csv")
_BESIDE = ".shx .dbf .prj .cpg -wal -journal .aux.xml .msk .ovr .aux .tfw .tifw .tiffw .wld .tab"
"""Endings of the files that the libraries open beside one."""


@contextmanager
def named(file: str, layer: str | None = None) -> Iterator[Path]:
    """Gives the path of a file, and names it and its layer in errors; warnings are silenced."""
    path = user_path(file)
    place = f"{path}, layer {layer}" if layer else str(path)
    try:
        with warnings.catch_warnings(action="ignore"):  # damage is reported as an error
            yield path
    except UserError as error:
        raise UserError(printable(f"{place}: {error}")) from None
    except OSError as error:
        raise UserError(printable(f"{place}: {error.strerror or error}")) from None


@contextmanager
def damage(expected: str) -> Iterator[None]:
    """Turns the errors of libraries, which are of many types, into one line."""
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        lines = str(error.__cause__ or error).strip().splitlines() or [type(error).__name__]
        raise ask(lines[0][:200], expected) from None


def find_format(path: Path) -> str:
    """Returns the format of a file or folder, and checks that it is safe to open."""
    if path.is_dir():
        return "grids" if members(path)[0].name.startswith(GRIDS) else "folder"
    kind, size = _format(path), path.stat().st_size
    if kind in ("csv", "kml", "points", "json") and size > MAX_BYTES:
        raise ask(f"{size} bytes", f"a text file of at most {MAX_BYTES}")
    # To GDAL, shapes that are cut off are empty. The seventh number of the header is the length.
    if kind == "shp" and size < (told := 2 * int(np.fromfile(path, ">i4", 7)[-1])):
        raise ask(f"{path.name} is damaged: {size} bytes", f"{told} bytes")
    for part in _beside(path):
        # GDAL opens masks and overviews in any format; some formats read other addresses.
        if part.suffix.lower() in (".msk", ".ovr") and _format(part) != "tif":
            raise ask(f"{part.name}, beside it, is no TIFF", "one, or no such file")
    for package in () if kind in ("npy", "points") else ("rasterio", "geopandas"):
        require(package, "geo", path.name)
    return kind


def _format(path: Path) -> str:
    """Returns the format of a regular file; a pipe, for example, would block for ever."""
    with open_regular(path, 2**63) as file:
        head = file.read(4096)
    for kind, start in _HEADS.items():
        if head and re.match(start, head):
            return kind
    known = "GeoTIFF, NetCDF, ESRI ASCII, .npy, .shp, .gpkg, GeoJSON, KML, KMZ, the paper's text"
    raise ask(f"{path.name} begins with {head[:16]!r}", f"{known}, CSV of latitude,longitude,...")


def _beside(path: Path) -> list[Path]:
    """Returns the files that belong to a file, with its name and an ending, in any case."""
    names = {f"{name}{end}".lower() for name in (path.stem, path.name) for end in _BESIDE.split()}
    return sorted(part for part in path.parent.iterdir() if part.name.lower() in names)


def members(folder: Path) -> list[Path]:
    """Returns the maps of Cell2Fire in a folder, in the order of their numbers, or perimeters."""
    paths = [path for path in folder.iterdir() if path.suffix.lower() in _SUFFIXES]
    paths = [path for path in paths if path.name.startswith(GRIDS)] or paths
    if not 0 < len(paths) <= _MAX_FILES:
        known = f"1 to {_MAX_FILES} of {', '.join(_SUFFIXES)}, or {GRIDS}*.csv"
        raise ask(f"a folder with {len(paths)} files of fires", known)
    return sorted(paths, key=lambda path: (len(path.name), path.name))


def digest(files: Iterable[str]) -> str:
    """Returns the SHA-256 of files and the files beside them, and of the fires of folders."""
    content = hashlib.sha256()
    for file in files:
        with named(file) as path:
            mains = members(path) if path.is_dir() else [path]
            for part in [part for main in mains for part in (main, *_beside(main))]:
                content.update(part.name.removeprefix(path.stem).encode())  # it may hold a date
                with open_regular(part, 2**63) as opened:
                    content.update(hashlib.file_digest(opened, "sha256").digest())  # pyright: ignore
    return content.hexdigest()
