"""Finds the format of a file by its name and its first bytes, which must agree."""

import hashlib
import os
import re
import sqlite3
import struct
import zipfile
import zlib
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.parsers import expat

from emberlink.envs.fire_files.gdal_files import check_geojson, kml_parts
from emberlink.envs.fire_files.sidecars import check_sidecars, read_beside
from emberlink.envs.utils.errors import UserError

MAX_BYTES = 300_000_000
"""Bytes of a text file."""
MAX_JSON = 100_000_000
"""Bytes of GeoJSON, which takes up to 17 times as much memory while it is checked."""
MAX_FILES = 500
"""Files of perimeters in a folder."""
_SAFE_NAME = re.compile(r"\w[\w.:+-]*")  # part of a shell's command as it is
_FIRMS = re.compile(rb'(?:\xef\xbb\xbf)?(?:"?country_id"?,)?"?latitude"?,"?longitude"?,')
_BESIDE = {".shp": (".shx", ".dbf", ".prj", ".cpg"), ".asc": (".prj",)}


@dataclass(frozen=True)
class Format:
    """A format of files."""

    name: str
    suffixes: tuple[str, ...]
    head: re.Pattern[bytes]
    """Matches the first bytes of a file of the format."""
    check: Callable[[Path], None] = lambda _: None
    """Raises a UserError for damage that the library that reads the file would not report."""


def _check_length(path: Path) -> None:
    _check_size(path.stat().st_size)


def _check_size(size: int, most: int = MAX_BYTES, kind: str = "a text file") -> None:
    if size > most:
        raise UserError(f"{size} bytes; {kind} has at most {most}")


def _check_json(path: Path) -> None:
    _check_size(path.stat().st_size, MAX_JSON, "GeoJSON")
    check_geojson(path.read_bytes())


def _check_kml(path: Path) -> None:
    _check_length(path)
    _parse_kml(path.read_bytes())


def _parse_kml(content: bytes) -> None:
    """Parses all of it, because GDAL returns the features before a damage."""
    parser = expat.ParserCreate()

    def check_root(tag: str, _: Any) -> None:
        parser.StartElementHandler = None
        if tag.rpartition(":")[2] != "kml":
            raise UserError(f"the first element is {tag[:40]!r}; expected KML")

    def refuse(*_: Any) -> None:
        raise UserError("a document type declaration; expected KML without one")

    parser.StartElementHandler, parser.StartDoctypeDeclHandler = check_root, refuse
    try:
        parser.Parse(content, True)
    except expat.ExpatError as error:
        raise UserError(f"{error}; expected KML") from None


def _check_kmz(path: Path) -> None:
    """Checks each .kml in an archive."""
    try:
        with zipfile.ZipFile(path) as archive:
            for part in kml_parts(archive):
                _check_size(part.file_size)
                _parse_kml(archive.read(part))
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
        raise UserError(f"{error}; expected KMZ") from None


def _check_sqlite(path: Path) -> None:
    """Checks all pages, because GDAL reads the rest of a file that was cut off."""
    try:
        uri = f"{path.absolute().as_uri()}?mode=ro&immutable=1"
        with closing(sqlite3.connect(uri, uri=True)) as database:
            result = database.execute("PRAGMA integrity_check(1)").fetchone()
            _check_counts(database)
    except sqlite3.Error as error:
        raise UserError(f"{error}; expected a GeoPackage") from None
    if result != ("ok",):
        raise UserError(f"{str(result[0])[:100]}; expected a whole GeoPackage")


def _check_counts(database: sqlite3.Connection) -> None:
    """Checks the stored numbers of features, because only as many are read."""
    kinds = "SELECT name FROM sqlite_master WHERE type = 'table'"
    if ("gpkg_ogr_contents",) not in database.execute(kinds).fetchall():
        return
    stored = "SELECT table_name, feature_count FROM gpkg_ogr_contents"
    for name, count in database.execute(stored).fetchall():
        quoted = str(name).replace('"', '""')
        (actual,) = database.execute(f'SELECT count(*) FROM "{quoted}"').fetchone()
        if count is not None and count != actual:
            raise UserError(f"layer {str(name)[:60]!r} has {actual} features and says {count}")


def _check_shapefile(path: Path) -> None:
    """Checks that the three files exist, are whole, and have the same number of features."""
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
KML = Format("KML", (".kml",), re.compile(_TEXT + rb"<"), _check_kml)
KMZ = Format("KMZ", (".kmz",), re.compile(rb"PK\x03\x04"), _check_kmz)
POINTS = Format(
    "the paper's text",
    (".txt", ".csv"),
    re.compile(rb"\s*?(?:\n|\Z)|(?:" + _NUMBERS + rb"){2,}[-+.\deE \t\r]*(?:\n|\Z)"),
    _check_length,
)
PERIMETERS = (SHAPEFILE, GEOJSON, GEOPACKAGE, KML, KMZ)
FORMATS = (NUMPY, GEOTIFF, ASCII, *PERIMETERS, POINTS)


def find_format(path: Path) -> Format:
    """Returns the format of a file and checks that the file is whole.

    Raises:
        UserError: there is no such file, its format is not known, or it is damaged.
    """
    _check_regular(path)
    head, suffix = _head(path, 4096), path.suffix.lower()
    if not head:
        raise UserError("the file is empty")
    if suffix in (".shx", ".dbf", ".prj"):
        raise UserError(
            f"a part of a shapefile; expected the .shp: {path.with_suffix('.shp').name}"
        )
    if suffix != ".kmz" and (suffix in (".zip", ".gz") or head[:4] == b"PK\3\4"):
        raise UserError("an archive; expected the files in it")
    _refuse_convertible(path, head)
    named = [known for known in FORMATS if suffix in known.suffixes]
    # A file that ends in .txt may be of any format.
    candidates = FORMATS if not named or POINTS in named else named
    for candidate in candidates:
        if candidate.head.match(head):
            check_sidecars(path)
            candidate.check(path)
            return candidate
    start = head[:16].decode("latin-1").encode("unicode_escape").decode()
    known = ", ".join(format.name for format in FORMATS)
    expected = f"{named[0].name}, as its name says" if named else known
    raise UserError(f"begins with {start!r}; expected {expected}")


def perimeter_files(folder: Path) -> list[Path]:
    """Returns the perimeters in a folder, sorted by name.

    Raises:
        UserError: there are none, or too many.
    """
    suffixes = [suffix for known in PERIMETERS for suffix in known.suffixes]
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in suffixes)
    if not 0 < len(paths) <= MAX_FILES:
        number = f"{len(paths)} files of" if paths else "without"
        raise UserError(
            f"a folder {number} perimeters ({', '.join(suffixes)}); expected a file, or a folder "
            f"of up to {MAX_FILES} files of perimeters of one fire"
        )
    return paths


def _refuse_convertible(path: Path, head: bytes) -> None:
    """Raises a UserError that says how to convert a format that is not read."""
    name = path.name if _SAFE_NAME.fullmatch(path.name) else "FILE"
    if head[:3] == b"CDF" or head[:4] == b"\x89HDF":
        raise UserError(
            "NetCDF, as of WRF-SFIRE; expected a GeoTIFF: gdal_translate -b LAST -a_ullr 0 HEIGHT "
            f"WIDTH 0 NETCDF:{name}:TIGN_G fire.tif (number of the last time; metres), read "
            "with fire.units=seconds and fire.end, the seconds of that time"
        )
    if _FIRMS.match(head):
        raise UserError(
            "points, as of FIRMS; expected perimeters: ogr2ogr -a_srs EPSG:4326 -oo "
            "X_POSSIBLE_NAMES=longitude -oo Y_POSSIBLE_NAMES=latitude -dialect sqlite -sql "
            "\"SELECT acq_date || 'T' || substr('000' || acq_time, -4, 2) || ':' || "
            "substr('000' || acq_time, -2) AS datetime, ST_Buffer(geometry, 0.002) AS geometry "
            f'FROM [{Path(name).stem}]" fire.gpkg {name}'
        )
    if path.name.startswith("ForestGrid") and path.suffix == ".csv":
        raise UserError(
            'a grid of Cell2Fire; expected an array of all: python -c "import glob, numpy as n; '
            "names = sorted(glob.glob('ForestGrid*.csv'), key=lambda f: (len(f), f)); burnt = "
            "n.array([n.loadtxt(f, delimiter=',') for f in names]) > 0; n.save('fire.npy', "
            'n.where(burnt.any(0), burnt.argmax(0), n.inf)[::-1].T)"'
        )


def beside(path: Path, suffix: str) -> Path | None:
    """Returns the file of the same name with another suffix, in lower or upper case."""
    names = (path.with_suffix(suffix), path.with_suffix(suffix.upper()))
    return next((name for name in names if name.exists()), None)


def digest(path: Path) -> str:
    """Returns the SHA-256 of a file and the files beside it, or of a folder's perimeters.

    Raises:
        UserError: a file is missing or cannot be read.
    """
    content = hashlib.sha256()
    if path.is_dir():
        for part in perimeter_files(path):
            content.update(f"{part.name}:{digest(part)}:".encode())
        return content.hexdigest()
    _check_regular(path)
    try:
        parts = {suffix: beside(path, suffix) for suffix in _BESIDE.get(path.suffix.lower(), ())}
        others = {part.name[len(path.stem) :]: part for part in read_beside(path)}
        for suffix, part in {"": path, **parts, **others}.items():
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
    """Checks that a path is a regular file. A pipe, for example, would block for ever."""
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
