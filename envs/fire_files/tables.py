"""Reads the features of vector files, and chooses those of one fire.

GeoPackage, shapefile, GeoJSON, KML, CSV and folders of them become one table of geopandas.
"""

import gc
import json
import re
import zipfile
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from emberlink.envs.fire_files.config import FileFireConfig
from emberlink.envs.fire_files.files import (
    MAX_BYTES,
    TABLES,
    check_prj,
    find_format,
    first_line,
    library,
    perimeter_files,
)
from emberlink.envs.fire_files.plane import parse_crs
from emberlink.envs.fire_files.report import ask
from emberlink.envs.utils.errors import UserError, unknown
from emberlink.envs.utils.validation import as_argument

FOLDERS = " > "
"""Between the names of folders, one within the other."""
_DEGREES = "EPSG:4326"
_OF_KML = ("Name", "Folder", "Description", "TimeStamp")
_IDENTIFIER = re.compile(
    r"(poly|attr)?(incident|incid|fire|event|burn|complex|cluster|merged?)s?"
    r"(name|nm|id|num|number|no|nr|code)?|fname|.*irwin.*|.*uniquefire.*"
)
"""Columns that identify a fire, by the letters and digits of their names."""
_MAYBE = re.compile(r"name|id|num|number|label|(f|fire|ig|ignition|event)?(year|yr)")
"""Columns that may also number the features, or name their times."""
_CATEGORY = re.compile(r".*(category|class|kind|type|status)|(poly)?featu\w*|incidentty|type.*")


def read_table(path: Path, kind: str, config: FileFireConfig) -> tuple[Any, list[str]]:
    """Returns the features of a file or folder, and the columns that stand outside of them.

    The index names the features in messages. Columns outside the attributes may hold a date.
    """
    if kind != "folder":
        return _of_file(path, kind, config)
    frames, outside = [], {"File": None}
    for part in perimeter_files(path):
        try:
            if (form := find_format(part)) not in TABLES:
                raise ask(form, "perimeters")
            frame, others = _of_file(part, form, config)
            if frames and (frame.crs is None) != (frames[0].crs is None):
                raise ask("with and without projection", "one in each file")
        except UserError as error:
            raise UserError(f"{part.name}: {error}") from None
        lower = {name: str(name).lower() for name in frame.columns if name not in _OF_KML}
        frame = frame.rename(columns=lower).rename(index=f"{part.name}: {{}}".format)
        frames.append(frame.assign(File=part.stem).to_crs(frames[0].crs if frames else frame.crs))
        outside |= dict.fromkeys(lower.get(name, name) for name in others)
    return library("pandas").concat(frames), list(outside)


def _of_file(path: Path, kind: str, config: FileFireConfig) -> tuple[Any, list[str]]:
    geopandas, outside, layer = library("geopandas"), [], config.layer
    gc.disable()  # it takes two thirds of the time to parse a large text
    try:
        if kind == "json":
            frame, outside = _geojson(json.loads(path.read_bytes().decode("utf-8-sig")))
        elif kind in ("kml", "kmz"):
            rows = [row for text in _texts_of_kml(path, kind) for row in _kml(text)]
            if layer is not None:
                rows = [row for row in rows if layer in str(row["Folder"]).split(FOLDERS)]
            frame = geopandas.GeoDataFrame(rows, geometry="geometry", crs=_DEGREES)
            frame = frame.dropna(axis="columns", how="all")
            outside = [name for name in ("Name", "Folder") if name in frame]
        elif kind == "csv":
            table = library("pandas").read_csv(path, dtype=str, skipinitialspace=True)
            at = {str(name).lower(): table[name] for name in table.columns}
            points = geopandas.points_from_xy(at["longitude"], at["latitude"])
            frame = geopandas.GeoDataFrame(table, geometry=points, crs=_DEGREES)
        else:
            frame = _by_gdal(path.absolute(), layer)
    except UserError:
        raise
    except Exception as error:  # GDAL, text and geometries raise many types
        raise ask(first_line(error), "perimeters") from None
    finally:
        gc.enable()
    if not hasattr(frame, "geometry") or len(frame) == 0:
        raise ask("no feature with a geometry", "perimeters")
    check_prj(path, kind, frame.crs or config.crs)
    return frame.reset_index(drop=True).rename(index="feature {}".format), outside


def _by_gdal(path: Path, wanted: str | None) -> Any:
    """Reads the layer `wanted`, or the only layer with geometries."""
    pyogrio = library("pyogrio")
    names = [str(name) for name, kind in pyogrio.list_layers(path) if kind is not None]
    if wanted not in names and (wanted or len(names) != 1):
        keys = [as_argument("fire.layer", name) for name in names[:30]] or ["one"]
        raise ask(f"{len(names)} layers of perimeters", *keys)
    return pyogrio.read_dataframe(path, layer=wanted or names[0], datetime_as_string=True)


def _geojson(whole: Any) -> tuple[Any, list[str]]:
    """Reads GeoJSON; texts and numbers beside the features become columns, such as `valid_at`."""
    features = [whole] if whole.get("type") == "Feature" else whole.get("features")
    if whole.get("type") not in ("Feature", "FeatureCollection") or not isinstance(features, list):
        raise ask(f"type {str(whole.get('type'))[:40]!r}", "a FeatureCollection")
    crs: Any = _DEGREES
    if given := whole.get("crs"):
        if given.get("type") != "name":
            raise ask("its crs is a link, which is not followed", "a name, or none")
        crs = parse_crs(given["properties"]["name"])
    rows = [feature.get("properties") or {} for feature in features]
    shapes = _shapes([feature.get("geometry") for feature in features])
    frame = library("geopandas").GeoDataFrame(rows, geometry=shapes, crs=crs)
    if crs == _DEGREES and len(frame) and abs(frame.total_bounds).max() > 360:
        frame = frame.set_crs(None, allow_override=True)  # not as GeoJSON is defined
    about = {**whole, **(whole.get("properties") or {}), **(whole.get("metadata") or {})}
    taken = ("type", "name", *frame.columns)
    about = {k: v for k, v in about.items() if isinstance(v, str | int) and k not in taken}
    return frame.assign(**about), list(about)


def _shapes(geometries: Sequence[Any]) -> Sequence[Any]:
    """Returns geometries of GeoJSON; at once if all are polygons without holes, as circles are."""
    kinds = {g["type"] + str(len(g.get("coordinates", ()))) if g else "" for g in geometries}
    if kinds != {"Polygon1"}:
        shape = library("shapely.geometry").shape
        return [shape(geometry) if geometry else None for geometry in geometries]
    rings = [geometry["coordinates"][0] for geometry in geometries]
    of = np.repeat(np.arange(len(rings)), [len(ring) for ring in rings])
    flat = np.fromiter(chain.from_iterable(chain.from_iterable(rings)), float)
    points = flat.reshape(len(of), -1)[:, :2]
    shapely = library("shapely")
    return shapely.polygons(shapely.linearrings(points, indices=of))


def _texts_of_kml(path: Path, kind: str) -> list[bytes]:
    if kind == "kml":
        return [path.read_bytes()]
    with zipfile.ZipFile(path) as archive:
        parts = [part for part in archive.infolist() if part.filename.lower().endswith(".kml")]
        if not parts or sum(part.file_size for part in parts) > MAX_BYTES:
            raise ask(f"{len(parts)} .kml in it", f"one, of {MAX_BYTES} bytes at most")
        return [archive.read(part) for part in parts]


def _kml(content: bytes) -> Iterator[dict[str, Any]]:
    """Yields attributes and geometry of each placemark; a folder's time holds for what is in it."""
    if b"\0" in content[:1000] or re.search(rb"<!(DOCTYPE|ENTITY)", content, re.IGNORECASE):
        raise ask("a document type declaration or UTF-16", "plain KML")
    root = ElementTree.fromstring(content)
    for element in root.iter():
        element.tag = str(element.tag).rpartition("}")[2]
    if root.tag != "kml":
        raise ask(f"the first element is {root.tag[:40]!r}", "KML")
    rest: list[tuple[Any, list[str], str | None]] = [(root, [], None)]
    while rest:
        element, folders, time = rest.pop()
        for part in element:
            if part.tag in ("TimeStamp", "TimeSpan"):
                time = (part.findtext("when") or part.findtext("begin") or time or "").strip()
        if element.tag == "Placemark":
            row = {"Name": element.findtext("name"), "TimeStamp": time}
            row |= {"Folder": FOLDERS.join(folders), "Description": element.findtext("description")}
            for part in (*element.iter("Data"), *element.iter("SimpleData")):
                text = part.text if part.tag == "SimpleData" else part.findtext("value")
                row.setdefault(str(part.get("name")), (text or "").strip())
            yield {k: text or None for k, text in row.items()} | {"geometry": _geometry(element)}
            continue
        inner = [part for part in element if part.tag in ("Document", "Folder", "Placemark")]
        folders = [*folders, *filter(None, [element.findtext("name")])]
        rest += [(part, folders, time) for part in reversed(inner)]


def _geometry(mark: Any) -> Any:
    """Returns the geometry of a placemark of KML."""
    shapely, shapes, edges = library("shapely"), [], set()
    for area in mark.iter("Polygon"):
        edges |= {*area.iter()}
        outer, inner = (
            [_points(text) for side in area.iter(tag) for text in side.iter("coordinates")]
            for tag in ("outerBoundaryIs", "innerBoundaryIs")
        )
        shapes.append(shapely.Polygon(outer[0], inner))
    for part in mark.iter():
        if part not in edges and part.tag in ("LineString", "LinearRing", "Point"):
            make = shapely.Point if part.tag == "Point" else shapely.LineString
            shapes += [make(_points(text)) for text in part.iter("coordinates")]
    return shapes[0] if len(shapes) == 1 else shapely.GeometryCollection(shapes)


def _points(element: Any) -> list[tuple[float, float]]:
    pairs = (at.split(",") for at in re.sub(r"\s*,\s*", ",", element.text or "").split())
    return [(float(pair[0]), float(pair[1])) for pair in pairs]


def plain(name: Any) -> str:
    """Returns the letters and digits of a column's name, in lower case."""
    return re.sub(r"[\W_]", "", str(name).lower())


def texts(column: Any) -> Any:
    """Returns the values of a column as texts; missing values are empty."""
    written = column.astype(str).fillna("")
    read = {text: re.sub(r"\.0$", "", text).strip() for text in written.unique()}
    return written.map(read).where(column.notna(), "")


def attributes(frame: Any) -> list[Any]:
    """Returns the columns of a table without that of the geometry."""
    return [name for name in frame.columns if name != frame.geometry.name]


def column_named(name: str, columns: Sequence[Any], key: str) -> Any:
    """Returns the column with a name in any case."""
    for column in columns:
        if str(column).lower() == name.strip().lower():
            return column
    known = ", ".join(map(str, columns[:30])) or "none"
    raise UserError(f"no column {name.strip()!r} ({key}); there are {known}")


def choose_features(frame: Any, config: FileFireConfig, facts: list[str]) -> Any:
    """Returns the features of one fire; notes on the others are appended to `facts`."""
    for key, choose in (("where", _where), ("incident", _of_incident)):
        kept = choose(frame, attributes(frame), config, facts)
        if len(kept) < len(frame):
            left_out = len(frame) - len(kept)
            facts.append(f"{left_out} left out by fire.{key}={getattr(config, key)}")
        frame = kept
    return frame


def _where(frame: Any, columns: Sequence[Any], config: FileFireConfig, _: list[str]) -> Any:
    """Returns the features that `fire.where` keeps; asks if a category has several values."""
    where = config.where
    if where is not None and where != "*":
        name, equals, pattern = where.partition("=")
        values = texts(frame[column := column_named(name, columns, "fire.where")])
        escaped = re.escape(pattern.strip()).replace(r"\*", ".*").replace(r"\|", "|")
        keeps = values.str.fullmatch(escaped, case=False) if equals else values != ""
        if not keeps.any():
            raise UserError(f"fire.where={where} keeps no feature; {_counts(frame, column)}")
        return frame[keeps]
    for column in columns if where is None else ():
        values, sure = texts(frame[column]), re.search("categ|featu", plain(column)) is not None
        if _CATEGORY.fullmatch(plain(column)) and 1 < values.nunique() < len(frame) + sure:
            choice = as_argument("fire.where", f"{column}={values.mode().iloc[0]}")
            seen = f"features of several kinds: {_counts(frame, column)}"
            raise ask(seen, choice, "fire.where=* for all of them")
    return frame


def _of_incident(frame: Any, columns: list[Any], config: FileFireConfig, facts: list[str]) -> Any:
    """Returns the features of `fire.incident`; asks if identifiers differ."""
    wanted, field = config.incident, config.incident_field
    if wanted == "*":
        return frame
    sure = [name for name in columns if _IDENTIFIER.fullmatch(plain(name))]
    known = [*sure, *(name for name in columns if _MAYBE.fullmatch(plain(name)))]
    places = known if field is None else [column_named(field, columns, "fire.incident_field")]
    other = "fire.incident=* for all as one fire"
    if wanted is not None:
        name = str(wanted).strip().lower()
        found = [at for at in places if (texts(frame[at]).str.lower() == name).any()]
        if not found:
            values = {text for at in places for text in texts(frame[at]) if text}
            raise UserError(f"fire.incident={unknown(str(wanted), sorted(values)[:30])}")
        frame, places = frame[texts(frame[found[0]]).str.lower() == name], known
        other = f"fire.incident_field={found[0]} beside fire.incident for all of these"
    counts = {name: texts(frame[name]).replace("", None).nunique() for name in places}
    certain = sure if field is None or wanted is not None else places
    several = [name for name, n in counts.items() if 1 < n < len(frame) + (name in certain)]
    listed = "; ".join(_counts(frame, name) for name in several)
    if several and wanted is not None and field is not None:
        facts.append(f"which differ in {listed}")
    elif several:
        values = texts(frame[several[0]])
        value = as_argument("fire.incident", values[values != ""].iloc[0])
        seen = f"{len(frame)} features of several fires: {listed}"
        raise ask(seen, f"fire.incident_field={several[0]} {value}", other)
    return frame


def _counts(frame: Any, column: Any) -> str:
    """Returns the values of a column with the number of features of each."""
    counts = texts(frame[column]).value_counts()
    shown = [f"{value or '(none)'} ({count})" for value, count in counts.head(12).items()]
    return f"{column}: {', '.join(shown)}{', ...' if len(counts) > 12 else ''}"
