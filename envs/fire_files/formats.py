"""The format of a file: by its name and its first bytes; both must agree."""

import hashlib
import json
import os
import re
import sqlite3
import struct
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from emberlink.envs.utils.errors import UserError

MAX_BYTES = 300_000_000
"""Of a text file."""
_BESIDE = {".shp": (".shx", ".dbf", ".prj", ".cpg"), ".asc": (".prj",)}
_BESIDE |= {".tif": (".tfw",), ".tiff": (".tfw",)}


@dataclass(frozen=True)
class Format:
    """A format of files."""

    name: str
    suffixes: tuple[str, ...]
    head: re.Pattern[bytes]
    """Matches the first bytes of a file of the format."""
    check: Callable[[Path], None] = lambda _: None
    """Raises a UserError for damage that the library that reads it would not notice."""


def _check_length(path: Path) -> None:
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise UserError(f"{size} bytes; a text file may have {MAX_BYTES}")


def _check_json(path: Path) -> None:
    """Parses it all, because GDAL returns the features before a damage."""
    _check_length(path)
    try:
        content = json.loads(path.read_bytes().decode("utf-8-sig"))
    except RecursionError:
        raise UserError("too many levels; expected GeoJSON") from None
    except UnicodeDecodeError as error:
        raise UserError(f"no text at byte {error.start}; expected GeoJSON in UTF-8") from None
    except ValueError as error:
        raise UserError(f"{error}; expected GeoJSON") from None
    if content.get("type") not in ("FeatureCollection", "Feature"):
        raise UserError(f"type {str(content.get('type'))[:40]!r}; expected a FeatureCollection")


def _check_sqlite(path: Path) -> None:
    """Checks all pages, because GDAL reads what is left of a file that was cut off."""
    try:
        uri = f"{path.absolute().as_uri()}?mode=ro&immutable=1"
        with closing(sqlite3.connect(uri, uri=True)) as database:
            result = database.execute("PRAGMA integrity_check(1)").fetchone()
    except sqlite3.Error as error:
        raise UserError(f"{error}; expected a GeoPackage") from None
    if result != ("ok",):
        raise UserError(f"{str(result[0])[:100]}; expected a whole GeoPackage")


def _check_shapefile(path: Path) -> None:
    """Checks that the three files are there, whole, and of as many features."""
    heads: dict[str, tuple[str, bytes, int]] = {}
    for suffix in (".shp", ".shx", ".dbf"):
        part = beside(path, suffix)
        if part is None:
            raise UserError(f"{path.with_suffix(suffix).name} is missing beside it")
        _check_regular(part)
        heads[suffix] = part.name, _head(part, 100), part.stat().st_size
    for name, head, size in (heads[".shp"], heads[".shx"]):
        length = 2 * struct.unpack(">I", head[24:28])[0] if len(head) == 100 else -1
        if head[:4] != b"\0\0\x27\x0a" or length != size:
            raise UserError(f"{name} has {size} bytes; by its header {length}: damaged")
    name, head, size = heads[".dbf"]
    records, start, length = struct.unpack("<IHH", head[4:12]) if len(head) >= 32 else (0, 32, 0)
    if start + records * length > size:
        raise UserError(
            f"{name} has {size} bytes; by its header {start + records * length}: cut off"
        )
    features = (heads[".shx"][2] - 100) // 8
    if records != features:
        raise UserError(f"{name} has {records} records, the .shx {features}: damaged")


_TEXT = rb"(?:\xef\xbb\xbf)?\s*"  # after a byte order mark
_NUMBERS = rb"[-+.\deE \t\r]*,"
NUMPY = Format("NumPy bank", (".npy",), re.compile(rb"\x93NUMPY"))
GEOTIFF = Format("GeoTIFF", (".tif", ".tiff"), re.compile(rb"II[*+]\0|MM\0[*+]"))
ASCII = Format(
    "ESRI ASCII",
    (".asc", ".agr", ".grd"),
    re.compile(_TEXT + rb"(?i:ncols|nrows)"),
    _check_length,
)
SHAPEFILE = Format("shapefile", (".shp",), re.compile(rb"\0\0\x27\x0a"), _check_shapefile)
GEOJSON = Format("GeoJSON", (".geojson", ".json"), re.compile(_TEXT + rb"\{"), _check_json)
GEOPACKAGE = Format("GeoPackage", (".gpkg",), re.compile(rb"SQLite format 3\0"), _check_sqlite)
POINTS = Format(
    "the paper's text",
    (".txt", ".csv"),
    re.compile(rb"\s*?(?:\n|\Z)|(?:" + _NUMBERS + rb"){2,}[-+.\deE \t\r]*(?:\n|\Z)"),
    _check_length,
)
FORMATS = (NUMPY, GEOTIFF, ASCII, SHAPEFILE, GEOJSON, GEOPACKAGE, POINTS)


def find_format(path: Path) -> Format:
    """Returns the format of a file, whole as far as can be seen without its library.

    Raises:
        UserError: there is no such file, or its format is not known.
    """
    _check_regular(path)
    head, suffix = _head(path, 4096), path.suffix.lower()
    if not head:
        raise UserError("the file is empty")
    if suffix in (".shx", ".dbf", ".prj"):
        raise UserError(
            f"a part of a shapefile; expected the .shp: {path.with_suffix('.shp').name}"
        )
    if suffix in (".zip", ".kmz", ".gz") or head[:4] == b"PK\3\4":
        raise UserError("an archive; expected the files in it")
    named = [known for known in FORMATS if suffix in known.suffixes]
    # A file that ends in .txt may be anything.
    candidates = FORMATS if not named or POINTS in named else named
    for candidate in candidates:
        if candidate.head.match(head):
            candidate.check(path)
            return candidate
    start = head[:16].decode("latin-1").encode("unicode_escape").decode()
    known = ", ".join(format.name for format in FORMATS)
    expected = f"{named[0].name}, as its name says" if named else known
    raise UserError(f"begins with {start!r}; expected {expected}")


def beside(path: Path, suffix: str) -> Path | None:
    """Returns the file of the same name with another suffix, in lower or upper case."""
    names = (path.with_suffix(suffix), path.with_suffix(suffix.upper()))
    return next((name for name in names if name.exists()), None)


def digest(path: Path) -> str:
    """Returns the sha256 of a file and of the files beside it that are read with it.

    Raises:
        UserError: the file is missing or cannot be read.
    """
    _check_regular(path)
    content = hashlib.sha256()
    try:
        for suffix in ("", *_BESIDE.get(path.suffix.lower(), ())):
            part = beside(path, suffix) if suffix else path
            if part is not None and part.is_file():
                content.update(f"{suffix}:{part.stat().st_size}:".encode())
                with part.open("rb") as file:
                    while block := file.read(1 << 20):
                        content.update(block)
    except OSError as error:
        raise UserError(f"cannot be read: {error.strerror or error}") from None
    return content.hexdigest()


def _head(path: Path, count: int) -> bytes:
    with path.open("rb") as file:
        return file.read(count)


def _check_regular(path: Path) -> None:
    """Checks that a path is a regular file: a pipe would never end."""
    try:
        path.stat()
    except FileNotFoundError:
        raise UserError("there is no such file") from None
    except (OSError, ValueError) as error:
        raise UserError(f"cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if path.is_dir():
        raise UserError("a folder; expected a file")
    if not path.is_file():
        raise UserError("no regular file")
    if not os.access(path, os.R_OK):
        raise UserError("cannot be read: permission denied")
