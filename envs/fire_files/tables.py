"""Reads the features of vector files, and chooses the features of one fire.

GeoPackage, shapefile, GeoJSON, KML, CSV and folders of them become one table of geopandas, with its
attributes as texts, empty where they are missing.
"""

import gc
import io
import json
import re
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from emberlink.envs.fire_files.config import FileFireConfig
from emberlink.envs.fire_files.files import MAX_BYTES, find_format, first_line, library, members
from emberlink.envs.fire_files.plane import parse_crs
from emberlink.envs.fire_files.report import ask
from emberlink.envs.utils.errors import UserError, unknown
from emberlink.envs.utils.validation import as_argument

FOLDERS = " > "
"""Between the names of folders, one within the other."""
_SHAPES = ("Point", "LineString", "Polygon", "MultiGeometry")
_DEGREES = "EPSG:4326"
_MAYBE = r"name|id|num|number|label|(f|fire|ig|ignition|event)?(year|yr)"
_IDENTIFIER = re.compile(
    r"(poly|attr)?(incident|incid|fire|event|burn|complex|cluster|merged?)s?"
    rf"(name|nm|id|num|number|no|nr|code)?|fname|.*irwin.*|.*uniquefire.*|{_MAYBE}"
)
"""Columns that identify a fire, or maybe the features or times, by the letters of their names."""
_CATEGORY = re.compile(r".*(category|class|kind|type|status)|(poly)?featu\w*|incidentty|type.*")


def read_table(path: Path, kind: str, config: FileFireConfig) -> tuple[Any, list[str]]:
    """Returns the features of a file or folder, and the columns that stand outside of them.

    The index names the features in messages. Columns outside the attributes may hold a date.
    """
    if kind != "folder":
        return _of_file(path, kind, config.layer)
    frames, outside = [], {"File": None}
    for part in members(path):
        try:
            frame, others = _of_file(part, find_format(part), config.layer)
            if frames and (frame.crs is None) != (frames[0].crs is None):
                raise ask("with and without projection", "one in each file")
        except UserError as error:
            raise UserError(f"{part.name}: {error}") from None
        frame = frame.rename(index=f"{part.name}: {{}}".format).assign(File=part.stem)
        frames.append(frame.to_crs(frames[0].crs if frames else frame.crs))
        outside |= dict.fromkeys(others)
    whole = library("pandas").concat(frames)
    return whole.fillna(dict.fromkeys(attributes(whole), "")), list(outside)


def _of_file(path: Path, kind: str, layer: str | None) -> tuple[Any, list[str]]:
    readers = {"json": _geojson, "kml": _kml, "kmz": _kml, "csv": _csv}
    library("geopandas")
    gc.disable()  # it takes two thirds of the time to parse a large text
    try:
        frame, outside = readers.get(kind, _by_gdal)(path, layer)
        if not hasattr(frame, "geometry") or len(frame) == 0:
            raise ask("no feature with a geometry", "perimeters")
    except UserError:
        raise
    except Exception as error:  # GDAL, text and geometries raise many types
        raise ask(first_line(error), "perimeters") from None
    finally:
        gc.enable()
    frame = frame.assign(**{name: _texts(frame[name]) for name in attributes(frame)})
    return frame.reset_index(drop=True).rename(index="feature {}".format), outside


def _csv(path: Path, _: str | None) -> tuple[Any, list[str]]:
    table = library("pandas").read_csv(path, dtype=str, skipinitialspace=True)
    at = {str(name).lower(): table[name] for name in table.columns}
    points = library("geopandas").points_from_xy(at["longitude"], at["latitude"])
    return library("geopandas").GeoDataFrame(table, geometry=points, crs=_DEGREES), []


def _by_gdal(path: Path, wanted: str | None) -> tuple[Any, list[str]]:
    """Reads the layer `wanted`, or the only layer with geometries."""
    pyogrio = library("pyogrio")
    path = path.absolute()
    names = [str(name) for name, kind in pyogrio.list_layers(path) if kind is not None]
    if wanted not in names and (wanted or len(names) != 1):
        keys = [as_argument("fire.layer", name) for name in names[:30]]
        raise ask(f"{len(names)} layers of perimeters", *keys)
    return pyogrio.read_dataframe(path, layer=wanted or names[0], datetime_as_string=True), []


def _geojson(path: Path, _: str | None) -> tuple[Any, list[str]]:
    """Reads GeoJSON; texts and numbers beside the features become columns, such as `valid_at`."""
    whole = json.loads(path.read_bytes())
    features = [whole] if whole.get("type") == "Feature" else whole.get("features")
    if whole.get("type") not in ("Feature", "FeatureCollection") or not isinstance(features, list):
        raise ask(f"type {str(whole.get('type'))[:40]!r}", "a FeatureCollection")
    crs: Any = _DEGREES
    if given := whole.get("crs"):
        if given.get("type") != "name":
            raise ask("its crs is a link, which is not followed", "a name, or none")
        crs = parse_crs(given["properties"]["name"])
    for shape in (feature.get("geometry") or {} for feature in features):
        if shape.get("type") == "Polygon":  # shapely reads arrays twice as fast
            shape["coordinates"] = [np.array(ring) for ring in shape["coordinates"]]
    frame = library("geopandas").GeoDataFrame.from_features(features, crs=crs)
    if crs == _DEGREES and abs(frame.total_bounds).max() > 360:
        frame = frame.set_crs(None, allow_override=True)  # not as GeoJSON is defined
    about = {**whole, **(whole.get("properties") or {}), **(whole.get("metadata") or {})}
    taken = ("type", "name", *frame.columns)
    about = {k: v for k, v in about.items() if isinstance(v, str | int) and k not in taken}
    return frame.assign(**about), list(about)


def _kml(path: Path, layer: str | None) -> tuple[Any, list[str]]:
    """Returns the placemarks of KML or KMZ; GDAL gets their geometries alone."""
    rows, marks, contents = [], ElementTree.Element("Document"), [path.read_bytes()]
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            parts = [part for part in archive.infolist() if part.filename.lower().endswith(".kml")]
            if sum(part.file_size for part in parts) > MAX_BYTES:
                raise ask("its .kml is too large", f"{MAX_BYTES} bytes at most")
            contents = [archive.read(part) for part in parts]
    for content in contents:
        if b"\0" in content[:1000] or re.search(rb"<!(DOCTYPE|ENTITY)", content, re.IGNORECASE):
            raise ask("a document type declaration or UTF-16", "plain KML")
        root = ElementTree.fromstring(content)
        for element in root.iter():
            element.tag = str(element.tag).rpartition("}")[2]
        for row, element in _placemarks(root):
            if layer is None or layer in str(row["Folder"]).split(FOLDERS):
                rows.append(row)
                shapes = [part for part in element if part.tag in _SHAPES]
                ElementTree.SubElement(marks, "Placemark").extend(shapes)
    if not rows:
        raise ask("no placemark", "KML with perimeters")
    text = b"<kml>" + ElementTree.tostring(marks) + b"</kml>"
    shapes = library("pyogrio").read_dataframe(io.BytesIO(text), columns=[]).geometry
    frame = library("geopandas").GeoDataFrame(rows, geometry=shapes, crs=_DEGREES)
    return frame, ["Name", "Folder"]


def _placemarks(
    element: Any, folders: tuple[str, ...] = (), time: str | None = None
) -> Iterator[tuple[dict[str, str | None], Any]]:
    """Yields each placemark and its attributes; a folder's time holds for its contents."""
    for part in (*element.findall("TimeStamp"), *element.findall("TimeSpan")):
        time = part.findtext("when") or part.findtext("begin") or time
    if element.tag != "Placemark":
        folders = (*folders, *filter(None, [element.findtext("name")]))
        for part in element:
            if part.tag in ("Document", "Folder", "Placemark"):
                yield from _placemarks(part, folders, time)
        return
    row = {"Name": element.findtext("name"), "TimeStamp": time, "Folder": FOLDERS.join(folders)}
    row["Description"] = element.findtext("description")
    for part in (*element.iter("Data"), *element.iter("SimpleData")):
        row.setdefault(str(part.get("name")), "".join(part.itertext()).strip())
    for part in (element, *element.iter("MultiGeometry")):
        for ring in part.findall("LinearRing"):  # which is no geometry of its own for shapely
            ring.tag = "LineString"
    yield row, element


def plain(name: Any) -> str:
    """Returns the letters and digits of a column's name, in lower case."""
    return re.sub(r"[\W_]", "", str(name).lower())


def _texts(column: Any) -> Any:
    """Returns the values of a column as texts; missing values are empty."""
    written = column.astype(str).fillna("")
    read = {text: re.sub(r"\.0$", "", text).strip() for text in written.unique()}
    return written.map(read).where(column.notna(), "")


def attributes(frame: Any) -> list[Any]:
    """Returns the columns of a table except its geometry."""
    return [name for name in frame.columns if name != frame.geometry.name]


def column_named(name: str, frame: Any, key: str) -> Any:
    """Returns the column with a name in any case."""
    columns = attributes(frame)
    for column in columns:
        if str(column).lower() == name.strip().lower():
            return column
    known = ", ".join(map(str, columns[:30])) or "none"
    raise UserError(f"no column {name.strip()!r} ({key}); there are {known}")


def choose_features(frame: Any, config: FileFireConfig, facts: list[str]) -> Any:
    """Returns the features of one fire; notes on the others are appended to `facts`."""
    for key, choose in (("where", _where), ("incident", _of_incident)):
        kept = choose(frame, config)
        if left_out := len(frame) - len(kept):
            facts.append(f"{left_out} left out by fire.{key}={getattr(config, key)}")
        frame = kept
    return frame


def _where(frame: Any, config: FileFireConfig) -> Any:
    """Returns the features that `fire.where` keeps; asks if a category has several values."""
    if config.where is None:
        known = [name for name in attributes(frame) if _CATEGORY.fullmatch(plain(name))]
        for column in _several(frame, known, "categ|featu"):
            choice = as_argument("fire.where", f"{column}={frame[column].mode().iloc[0]}")
            seen = f"features of several kinds: {_counts(frame, column)}"
            raise ask(seen, choice, "fire.where=* for all of them")
    if config.where in (None, "*"):
        return frame
    name, equals, pattern = config.where.partition("=")
    values = frame[column := column_named(name, frame, "fire.where")]
    escaped = re.escape(pattern.strip()).replace(r"\*", ".*").replace(r"\|", "|")
    keeps = values.str.fullmatch(escaped, case=False) if equals else values != ""
    if not keeps.any():
        raise ask(f"fire.where={config.where} keeps no feature", _counts(frame, column))
    return frame[keeps]


def _of_incident(frame: Any, config: FileFireConfig) -> Any:
    """Returns the features of `fire.incident`; asks if identifiers differ."""
    wanted, field = config.incident, config.incident_field
    known = [name for name in attributes(frame) if _IDENTIFIER.fullmatch(plain(name))]
    places = known if field is None else [column_named(field, frame, "fire.incident_field")]
    if wanted == "*":
        return frame
    other = "fire.incident=* for all as one fire"
    if wanted is not None:
        is_it = {at: frame[at].str.lower() == str(wanted).strip().lower() for at in places}
        if not (found := [at for at in places if is_it[at].any()]):
            values = {text for at in places for text in frame[at] if text}
            raise UserError(f"fire.incident={unknown(str(wanted), sorted(values)[:30])}")
        frame = frame[is_it[found[0]]]
        if field is not None:
            return frame
        other = f"fire.incident_field={found[0]} beside fire.incident for all of these"
    if several := _several(frame, places, f"^(?!({_MAYBE})$)"):
        answer = as_argument("fire.incident", next(filter(None, frame[several[0]])))
        listed = "; ".join(_counts(frame, name) for name in several)
        seen = f"{len(frame)} features of several fires: {listed}"
        raise ask(seen, f"fire.incident_field={several[0]} {answer}", other)
    return frame


def _several(frame: Any, columns: list[Any], sure: str) -> list[Any]:
    """Returns the columns with several values; of unsure ones, not one for each feature."""
    counts = {name: frame[name].replace("", None).nunique() for name in columns}
    every = {name: len(frame) + bool(re.search(sure, plain(name))) for name in columns}
    return [name for name in columns if 1 < counts[name] < every[name]]


def _counts(frame: Any, column: Any) -> str:
    """Returns the values of a column with the number of features of each."""
    counts = frame[column].value_counts()
    shown = [f"{value or '(none)'} ({count})" for value, count in counts.head(12).items()]
    return f"{column}: {', '.join(shown)}{', ...' if len(counts) > 12 else ''}"
