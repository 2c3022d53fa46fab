"""Reads vector files into one table of features and texts, and chooses the features of a fire."""

import gc
import io
import re
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import orjson
import pandas
import pyogrio
from geopandas import GeoDataFrame, points_from_xy

from emberlink.envs.fire_files.config import FileFireConfig
from emberlink.envs.fire_files.files import MAX_BYTES, damage, find_format, members
from emberlink.envs.fire_files.plane import DEGREES
from emberlink.envs.fire_files.report import ask
from emberlink.envs.fire_files.times import FOLDERS, column_named, date_within, plain
from emberlink.envs.utils.errors import UserError, unknown
from emberlink.envs.utils.validation import as_argument

_SHAPES = ("Point", "LineString", "Polygon", "MultiGeometry")
_MAYBE_ID = r"name|nombre|nom|id|num|number|label|perim\w*id|(f|fire|ig|ignition|event)?(year|yr)"
_FIRE = r"(incident|incid|inc|fire|event|burn|complex|cpx|cluster|merged?|case)s?"
_ID = (
    rf"(poly|attr)?{_FIRE}|.*{_FIRE}(unique)?(n(ame?|am?|m)?|i(d\w*)?|nu(m\w*)?|no|nr|c(o(de?)?)?|desig|label)"
    r"|fname|fihname|.*irwin.*|.*uniqu(ef\w*)?|localincid|agencyfir|numparte|codsgif"
    r"|(id|num|cod|nom|nombre)?(incendi[oea]|feu|fogo|brand)(id|nr|name)?"
)
"""Columns that identify a fire, by the letters of their names, or maybe features or times."""
_MAYBE_KIND = (
    r".*(class|kind|type|status|symbol|(fire|incident)typ?)|layer|folder"
    r"|(type|tipo|kind|kategorie|treatment|delete|(is)?(prescri|planned|rx)).*"
)
_KIND = r".*categ.*|(poly)?featu\w*"
"""Columns of kinds of features, or maybe descriptions of each."""


def read_table(path: Path, kind: str, layer: str | None) -> tuple[Any, Any]:
    """Returns attributes and shapes of the features of a file or folder, indexed by their names."""
    if kind != "folder":
        frame = _of_file(path, kind, layer)
    else:
        frames = [
            _of_file(part, find_format(part), layer)
            .assign(File=part.stem)
            .rename(index=f"{part.name}: {{}}".format)
            for part in members(path)
        ]
        with damage("the same projection, or none, in each file"):
            frame = pandas.concat([part.to_crs(frames[0].crs) for part in frames])
    return frame.drop(columns="geometry").fillna(""), frame.geometry


def _of_file(path: Path, kind: str, layer: str | None) -> Any:
    readers = {"json": _geojson, "kml": _kml, "kmz": _kml, "csv": _csv}
    gc.disable()  # it takes two thirds of the time to parse a large text
    try:
        with damage(f"perimeters in {path.name}"):
            frame = readers.get(kind, _by_gdal)(path, layer)
    finally:
        gc.enable()
    table = frame.drop(columns=frame.geometry.name).apply(_texts)
    return GeoDataFrame(table, geometry=frame.geometry).rename(index="feature {}".format)


def _texts(column: Any) -> Any:
    """Returns the values of a column as texts; missing values are empty."""
    texts = column.astype(str).str.strip().str.removesuffix(".0")
    return texts.where(column.notna(), "")


def _csv(path: Path, _: str | None) -> Any:
    table = pandas.read_csv(path, dtype=str, skipinitialspace=True)
    at = {str(name).lower(): table[name] for name in table.columns}
    points = points_from_xy(at["longitude"], at["latitude"])
    return GeoDataFrame(table, geometry=points, crs=DEGREES)


def _by_gdal(path: Path, wanted: str | None) -> Any:
    """Reads the layer `wanted`, or the only layer with geometries."""
    path = path.absolute()
    names = [str(name) for name, kind in pyogrio.list_layers(path) if kind is not None]
    if wanted not in names and (wanted or len(names) != 1):
        keys = [as_argument("fire.layer", name) for name in names[:30]]
        raise ask(f"{len(names)} layers of perimeters", *keys)
    return pyogrio.read_dataframe(path, layer=wanted or names[0], datetime_as_string=True)


def _geojson(path: Path, _: str | None) -> Any:
    """Reads GeoJSON; texts and numbers beside the features become columns, such as `valid_at`."""
    whole = orjson.loads(path.read_bytes().removeprefix(b"\xef\xbb\xbf"))
    if whole.get("type") not in ("Feature", "FeatureCollection"):
        raise ask(f"JSON of type {whole.get('type')!r}", "GeoJSON: a Feature or FeatureCollection")
    features = [whole] if whole.get("type") == "Feature" else whole["features"]
    crs: Any = DEGREES
    if given := whole.get("crs"):
        if given.get("type") != "name":
            raise ask("its crs is a link, which is not followed", "a name, or none")
        crs = given["properties"]["name"]
    for shape in (feature.get("geometry") or {} for feature in features):
        if shape.get("type") == "Polygon":  # shapely reads arrays twice as fast
            shape["coordinates"] = [np.array(ring) for ring in shape["coordinates"]]
    frame: Any = GeoDataFrame.from_features(features, crs=crs)
    if crs == DEGREES and abs(frame.total_bounds).max() > 360:
        frame = frame.set_crs(None, allow_override=True)  # not as GeoJSON is defined
    about = {**whole, **(whole.get("properties") or {}), **(whole.get("metadata") or {})}
    taken = ("type", "name", "timeStamp", *frame.columns)  # the time of the download, in OGC API
    more = {k: v for k, v in about.items() if isinstance(v, str | int | float) and k not in taken}
    return frame.assign(**more)


def _kml(path: Path, _: str | None) -> Any:
    """Returns the placemarks of KML or KMZ; GDAL gets their geometries alone."""
    contents = [path.read_bytes()]
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            parts = [part for part in archive.infolist() if part.filename.lower().endswith(".kml")]
            if not parts:
                raise ask("an archive without .kml", "a KMZ, or the files of others unpacked")
            if sum(part.file_size for part in parts) > MAX_BYTES:
                raise ask("its .kml is too large", f"{MAX_BYTES} bytes at most")
            contents = [archive.read(part) for part in parts]
    rows, marks = [], ElementTree.Element("Document")
    for content in contents:
        root = ElementTree.fromstring(content)
        for element in root.iter():
            element.tag = str(element.tag).rpartition("}")[2]
        for row, shapes in _placemarks(root):
            rows.append(row)
            ElementTree.SubElement(marks, "Placemark").extend(shapes)
    text = b"<kml>" + ElementTree.tostring(marks) + b"</kml>"
    shapes = pyogrio.read_dataframe(io.BytesIO(text), columns=[]).geometry
    return GeoDataFrame(rows, geometry=shapes, crs=DEGREES)


def _placemarks(
    element: Any, folders: tuple[str, ...] = (), time: str | None = None
) -> Iterator[tuple[dict[str, str | None], list[Any]]]:
    """Yields attributes and shapes of each placemark; a folder's time holds for its contents."""
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
        if not row.get(name := str(part.get("name"))):
            row[name] = (part.findtext("value") or "".join(part.itertext())).strip()
    for part in (element, *element.iter("MultiGeometry")):
        for ring in part.findall("LinearRing"):  # GDAL reads a ring only within a polygon
            ring.tag = "LineString"
    yield row, [part for part in element if part.tag in _SHAPES]


def choose_features(table: Any, config: FileFireConfig, facts: list[str]) -> Any:
    """Returns the features of one fire; notes on the others are appended to `facts`."""
    where = " and ".join(config.conditions)
    for key, choose in ((f"where={where}", _where), (f"incident={config.incident}", _of_incident)):
        kept = choose(table, config)
        if left_out := len(table) - len(kept):
            facts.append(f"{left_out} left out by fire.{key}")
        table = kept
    return table


def _where(table: Any, config: FileFireConfig) -> Any:
    """Returns the features that `fire.where` keeps; asks if there are several kinds."""
    given, decided = config.conditions, []
    for condition in (text for text in given if text != "*"):
        name, equals, pattern = condition.partition("=")
        values = table[name := column_named(name, table, "fire.where")]
        form = re.escape(pattern.strip()).replace(r"\*", ".*").replace(r"\|", "|")
        kept = table[values.str.fullmatch(form, case=False) if equals else values != ""]
        if kept.empty:
            raise ask(f"fire.where={condition} keeps no feature", _counts(table, [name]))
        table, decided = kept, [*decided, name]
    if "*" in given:
        return table
    if not (several := _several(table.drop(columns=decided), _KIND, _MAYBE_KIND)):
        return table
    choice = f"{several[0]}={table[several[0]].mode().iloc[0]}"
    every = f"{as_argument('fire.where', *given, '*')} for all of them"
    seen = f"features of several kinds: {_counts(table, several[:1])}"
    raise ask(seen, as_argument("fire.where", *given, choice), every)


def _of_incident(table: Any, config: FileFireConfig) -> Any:
    """Returns the features of `fire.incident`; asks if identifiers differ."""
    wanted, field = config.incident, config.incident_field
    if wanted == "*":
        return table
    other = "fire.incident=* for all as one fire"
    if wanted is not None:
        known = [name for name in table if re.fullmatch(f"{_ID}|{_MAYBE_ID}", plain(name))]
        places = known if field is None else [column_named(field, table, "fire.incident_field")]
        is_it = table[places].apply(lambda column: column.str.lower() == str(wanted).lower())
        if not is_it.any(axis=None):
            values = sorted({*table[places].to_numpy().flat} - {""})[:30]
            raise UserError(f"fire.incident={unknown(str(wanted), values)}")
        table = table[is_it[chosen := is_it.any().idxmax()]]
        other = f"{as_argument('fire.incident_field', chosen)} beside fire.incident for all these"
    if (several := _several(table, _ID, _MAYBE_ID)) and not (wanted and field):
        # Two fires may have one name, or be of one year.
        several.sort(key=lambda n: (-table[n].nunique(), not re.fullmatch(_ID, plain(n))))
        answer = as_argument("fire.incident", next(filter(None, table[several[0]])))
        seen = f"{len(table)} features of several fires: {_counts(table, several)}"
        raise ask(seen, f"{as_argument('fire.incident_field', several[0])} {answer}", other)
    return table


def _several(table: Any, sure: str, maybe: str) -> list[Any]:
    """Returns the columns with several values; of unsure ones, not dates or numbers of features."""
    names = []
    for name in table.columns[table.replace("", None).nunique() > 1]:
        is_it = re.fullmatch(sure, plain(name)) is not None
        if not is_it and re.fullmatch(maybe, plain(name)):
            texts = table[name]
            numbers = texts.is_unique and texts.str.contains(r"\d").any()
            is_it = not (numbers or texts.map(date_within).all())
        names += [name] if is_it else []
    return names


def _counts(table: Any, names: list[Any]) -> str:
    """Returns the values of columns with the number of features of each."""
    listed = []
    for name in names:
        counts = table[name].value_counts()
        shown = [f"{value or '(none)'} ({count})" for value, count in counts.head(12).items()]
        listed.append(f"{name}: {', '.join(shown)}{', ...' if len(counts) > 12 else ''}")
    return "; ".join(listed)
