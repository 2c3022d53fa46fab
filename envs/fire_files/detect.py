"""Which reader a file is for: by its name and by how it begins."""

import hashlib
import json
import os
import sqlite3
import struct
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from emberlink.envs.utils.errors import UserError

LONGEST_TEXT = 300_000_000
"""bytes of a file that is read as a whole"""
_BESIDE = {
    ".shp": (".shx", ".dbf", ".prj", ".cpg"),
    ".asc": (".prj",),
    ".tif": (".tfw",),
    ".tiff": (".tfw",),
}
"""files of the same name that are read too"""


@dataclass(frozen=True)
class Format:
    """A kind of file."""

    name: str
    suffixes: tuple[str, ...]
    begins: Callable[[bytes], bool]
    """whether the first bytes are such a file's"""
    check: Callable[[Path], None] = lambda _: None
    """that it is whole, where the library that reads it would not notice"""


def _tiff(head: bytes) -> bool:
    return head[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")


def _ascii(head: bytes) -> bool:
    return head.lstrip()[:5].lower() in (b"ncols", b"nrows")


def _points(head: bytes) -> bool:
    line = head.split(b"\n", 1)[0].strip()
    return not line.strip(b"0123456789+-.eE, \t\r\n") and (not line or line.count(b",") >= 2)


def _check_length(path: Path) -> None:
    if path.stat().st_size > LONGEST_TEXT:
        size = path.stat().st_size
        raise UserError(f"{size} bytes; a file of this kind may have {LONGEST_TEXT}")


def _check_json(path: Path) -> None:
    """GDAL returns the features before a damage."""
    _check_length(path)
    try:
        found = json.loads(path.read_bytes().decode("utf-8-sig"))
    except RecursionError:
        raise UserError("too many levels; expected GeoJSON") from None
    except UnicodeDecodeError as error:
        raise UserError(f"no text at byte {error.start}; expected GeoJSON in UTF-8") from None
    except ValueError as error:
        raise UserError(f"{error}; expected GeoJSON") from None
    if found.get("type") not in ("FeatureCollection", "Feature"):
        raise UserError(f"type {str(found.get('type'))[:40]!r}; expected a FeatureCollection")


def _check_sqlite(path: Path) -> None:
    """GDAL reads what is left of a file that was cut off."""
    try:
        uri = f"{path.absolute().as_uri()}?mode=ro&immutable=1"
        with closing(sqlite3.connect(uri, uri=True)) as database:
            found = database.execute("PRAGMA integrity_check(1)").fetchone()
    except sqlite3.Error as error:
        raise UserError(f"{error}; expected a GeoPackage") from None
    if found != ("ok",):
        raise UserError(f"{str(found[0])[:100]}; expected a whole GeoPackage")


def _check_shapefile(path: Path) -> None:
    """That the three files are there, whole, and of as many features."""
    for suffix in (".shp", ".shx", ".dbf"):
        part = beside(path, suffix)
        if part is None:
            raise UserError(f"{path.with_suffix(suffix).name} is missing beside it")
        _check_regular(part)
    counts: list[int] = []
    for suffix in (".shp", ".shx"):
        part = beside(path, suffix) or path
        head, size = _head(part, 100), part.stat().st_size
        said = 2 * struct.unpack(">I", head[24:28])[0] if len(head) == 100 else -1
        if head[:4] != b"\0\0\x27\x0a" or said != size:
            raise UserError(f"{part.name} has {size} bytes; by its header {said}: damaged")
        counts.append((size - 100) // 8)
    part = beside(path, ".dbf") or path
    head, size = _head(part, 32), part.stat().st_size
    if len(head) < 32:
        raise UserError(f"{part.name} has {size} bytes; expected a header of 32: damaged")
    records, start, length = struct.unpack("<IHH", head[4:12])
    if start + records * length > size:
        raise UserError(
            f"{part.name} has {size} bytes; by its header {start + records * length}: cut off"
        )
    if records != counts[1]:
        raise UserError(f"{part.name} has {records} records, the .shx {counts[1]}: damaged")


def _head(path: Path, count: int) -> bytes:
    with path.open("rb") as file:
        return file.read(count)


NUMPY = Format("NumPy bank", (".npy",), lambda head: head[:6] == b"\x93NUMPY")
GEOTIFF = Format("GeoTIFF", (".tif", ".tiff"), _tiff)
ASCII = Format("ESRI ASCII", (".asc", ".agr", ".grd"), _ascii, _check_length)
SHAPEFILE = Format("shapefile", (".shp",), lambda h: h[:4] == b"\0\0\x27\x0a", _check_shapefile)
GEOJSON = Format(
    "GeoJSON",
    (".geojson", ".json"),
    lambda head: head.removeprefix(b"\xef\xbb\xbf").lstrip()[:1] == b"{",
    _check_json,
)
GEOPACKAGE = Format(
    "GeoPackage", (".gpkg",), lambda h: h[:16] == b"SQLite format 3\0", _check_sqlite
)
POINTS = Format("the paper's text", (".txt", ".csv"), _points, _check_length)
FORMATS = (NUMPY, GEOTIFF, ASCII, SHAPEFILE, GEOJSON, GEOPACKAGE, POINTS)


def find_format(path: Path) -> Format:
    """The kind of a file, which is then whole as far as can be seen without its library.

    Raises:
        ValueError: one line, without the file's name: there is no such file, or none that is known.
    """
    _check_regular(path)
    head = _head(path, 4096)
    if not head:
        raise UserError("the file is empty")
    suffix = path.suffix.lower()
    if suffix in (".shx", ".dbf", ".prj"):
        raise UserError(
            f"a part of a shapefile; expected the .shp: {path.with_suffix('.shp').name}"
        )
    if suffix in (".zip", ".kmz", ".gz") or head[:4] == b"PK\3\4":
        raise UserError("an archive; expected the files in it")
    named = [one for one in FORMATS if suffix in one.suffixes]
    found = next((one for one in named or FORMATS if one.begins(head)), None)
    if found is None and named and named[0] is POINTS:  # what ends in .txt may be anything
        found = next((one for one in FORMATS if one.begins(head)), None)
    if found is None:
        start = head[:16].decode("latin-1").encode("unicode_escape").decode()
        what = f"{named[0].name}, as its name says" if named else ", ".join(o.name for o in FORMATS)
        raise UserError(f"begins with {start!r}; expected {what}")
    found.check(path)
    return found


def _check_regular(path: Path) -> None:
    """A pipe would never end, and a folder is no file."""
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


def beside(path: Path, suffix: str) -> Path | None:
    """The file of the same name with another suffix, in lower or upper case."""
    names = (path.with_suffix(suffix), path.with_suffix(suffix.upper()))
    return next((name for name in names if name.exists()), None)


def digest(path: Path) -> str:
    """sha256 of a file and of those beside it that are read with it.

    Raises:
        ValueError: as `find_format`, without the file's name.
    """
    _check_regular(path)
    found = hashlib.sha256()
    try:
        for suffix in ("", *_BESIDE.get(path.suffix.lower(), ())):
            part = beside(path, suffix) if suffix else path
            if part is not None and part.is_file():
                found.update(f"{suffix}:{part.stat().st_size}:".encode())
                with part.open("rb") as file:
                    while block := file.read(1 << 20):
                        found.update(block)
    except OSError as error:
        raise UserError(f"cannot be read: {error.strerror or error}") from None
    return found.hexdigest()
