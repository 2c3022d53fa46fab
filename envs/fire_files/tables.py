"""Reads the features of vector files: GeoPackage, shapefile, GeoJSON, KML, CSV, and folders."""

import json
import re
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

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
from emberlink.envs.fire_files.projection import parse_crs
from emberlink.envs.utils.errors import UserError

OUTSIDE = ("Name", "Folder", "File")
"""Columns for texts that stand outside the attributes, and may hold a date."""
_DEGREES = "EPSG:4326"


def read_table(path: Path, kind: str | None, config: FileFireConfig) -> tuple[Any, list[str]]:
    """Reads the features of a file, or of all files in a folder.

    Args:
        path: a file, or a folder of files of one fire.
        kind: format of the file, None for a folder.

    Returns:
        A table of geopandas with a row per feature, whose index names the features in messages, and
        the names of the columns whose values stand outside the attributes.
    """
    if kind is not None:
        return _of_file(path, kind, config.layer)
    frames, outside = [], ["File"]
    for part in perimeter_files(path):
        try:
            form = find_format(part)
            if form not in TABLES:
                raise UserError("expected perimeters")
            frame, others = _of_file(part, form, config.layer)
        except UserError as error:
            raise UserError(f"{part.name}: {error}") from None
        lower = {n: str(n).lower() for n in frame.columns if n not in (*OUTSIDE, "TimeStamp")}
        frame = frame.rename(columns=lower).assign(File=part.stem)
        twice = frame.columns[frame.columns.duplicated()]
        if len(twice):
            raise UserError(f"{part.name}: columns that differ in case only: {twice[0]}")
        if frames and (frame.crs is None) != (frames[0].crs is None):
            raise UserError(f"{part.name}: with and without projection; expected one in each file")
        frame = frame.rename(index=f"{part.name}: {{}}".format)
        frames.append(frame.to_crs(frames[0].crs) if frames and frame.crs else frame)
        outside += [lower.get(name, name) for name in others]
    return library("pandas").concat(frames), list(dict.fromkeys(outside))


def _of_file(path: Path, kind: str, layer: str | None) -> tuple[Any, list[str]]:
    geopandas, outside = library("geopandas"), []
    try:
        if kind == "json":
            frame, outside = _geojson(json.loads(path.read_bytes().decode("utf-8-sig")))
        elif kind in ("kml", "kmz"):
            frame, outside = _kml(path, kind, layer)
        elif kind == "csv":
            table = library("pandas").read_csv(path, dtype=str, skipinitialspace=True)
            at = {str(name).lower(): table[name] for name in table.columns}
            points = geopandas.points_from_xy(at["longitude"], at["latitude"])
            frame = geopandas.GeoDataFrame(table, geometry=points, crs=_DEGREES)
        else:
            frame = _by_gdal(path, layer)
    except UserError:
        raise
    except Exception as error:  # GDAL, text and geometries raise many types
        raise UserError(f"{first_line(error)}; expected perimeters") from None
    if not hasattr(frame, "geometry") or len(frame) == 0:
        raise UserError("no feature with a geometry; expected perimeters")
    check_prj(path, kind, frame.crs)
    return frame.reset_index(drop=True).rename(index="feature {}".format), outside


def _by_gdal(path: Path, wanted: str | None) -> Any:
    """Reads the layer `wanted`, or the only layer with geometries."""
    pyogrio = library("pyogrio")
    names = [str(name) for name, kind in pyogrio.list_layers(path.absolute()) if kind is not None]
    if wanted not in names and (wanted or len(names) != 1):
        known = ", ".join(names[:30]) or "none"
        raise UserError(f"{len(names)} layers of perimeters; expected fire.layer, one of {known}")
    about = {"layer": wanted or names[0], "datetime_as_string": True}
    return pyogrio.read_dataframe(path.absolute(), **about)


def _geojson(whole: Any) -> tuple[Any, list[str]]:
    """Reads GeoJSON; texts and numbers beside the features become columns, such as `valid_at`."""
    features = [whole] if whole.get("type") == "Feature" else whole.get("features")
    if whole.get("type") not in ("FeatureCollection", "Feature") or not isinstance(features, list):
        raise UserError(f"type {str(whole.get('type'))[:40]!r}; expected a FeatureCollection")
    crs: Any = _DEGREES
    if given := whole.get("crs"):
        if given.get("type") != "name":
            raise UserError("its crs is a link, which is not followed; expected a name, or none")
        crs = parse_crs(given["properties"]["name"])
    shape = library("shapely.geometry").shape
    shapes = [shape(f["geometry"]) if f.get("geometry") else None for f in features]
    rows = [f.get("properties") or {} for f in features]
    frame = library("geopandas").GeoDataFrame(rows, geometry=shapes, crs=crs)
    if crs == _DEGREES and len(frame) and abs(frame.total_bounds).max() > 360:
        frame = frame.set_crs(None, allow_override=True)  # not as GeoJSON is defined
    about = whole if whole["type"] == "FeatureCollection" else {}
    about = {**about, **(about.get("properties") or {}), **(about.get("metadata") or {})}
    taken = ("type", "name", *frame.columns)
    about = {k: v for k, v in about.items() if isinstance(v, str | int) and k not in taken}
    return frame.assign(**about), list(about)


def _kml(path: Path, kind: str, layer: str | None) -> tuple[Any, list[str]]:
    """Reads placemarks; a folder's time holds for the placemarks in it."""
    rows: list[dict[str, Any]] = []
    for content in _kml_texts(path, kind):
        if b"\0" in content[:1000] or re.search(rb"<!(DOCTYPE|ENTITY)", content, re.IGNORECASE):
            raise UserError("a document type declaration or UTF-16; expected plain KML")
        root = ElementTree.fromstring(content)
        if _tag(root) != "kml":
            raise UserError(f"the first element is {_tag(root)[:40]!r}; expected KML")
        rows += [_placemark(mark, folders, time) for mark, folders, time in _placemarks(root)]
    if layer is not None:
        rows = [row for row in rows if layer in str(row["Folder"]).split("/")]
    frame = library("geopandas").GeoDataFrame(rows, geometry="geometry", crs=_DEGREES)
    frame = frame.dropna(axis="columns", how="all")
    return frame, [name for name in ("Name", "Folder") if name in frame.columns]


def _kml_texts(path: Path, kind: str) -> Iterator[bytes]:
    """Yields the .kml of a file, or all in an archive."""
    if kind == "kml":
        yield path.read_bytes()
        return
    try:
        with zipfile.ZipFile(path) as archive:
            parts = [part for part in archive.infolist() if part.filename.lower().endswith(".kml")]
            if not parts or sum(part.file_size for part in parts) > MAX_BYTES:
                raise UserError(
                    f"{len(parts)} .kml in it; expected one of {MAX_BYTES} bytes at most"
                )
            for part in parts:
                yield archive.read(part)
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
        raise UserError(f"{error}; expected KMZ") from None


def _tag(element: Any) -> str:
    return str(element.tag).rpartition("}")[2]


def _texts(element: Any, *names: str) -> list[str]:
    """Returns the texts of the elements within one that have one of the names."""
    found = (part for part in element.iter() if _tag(part) in names)
    return [text for part in found if (text := (part.text or "").strip())]


def _placemarks(root: Any) -> Iterator[tuple[Any, list[str], str | None]]:
    """Yields each placemark, the names of the folders around it, and its time or theirs."""
    rest: list[tuple[Any, list[str], str | None]] = [(root, [], None)]
    while rest:
        element, folders, time = rest.pop()
        for part in element:
            if _tag(part) in ("TimeStamp", "TimeSpan"):
                time = next(iter(_texts(part, "when", "begin")), time)
        if _tag(element) == "Placemark":
            yield element, folders, time
            continue
        name = [part.text or "" for part in element if _tag(part) == "name"]
        inner = [part for part in element if _tag(part) in ("Document", "Folder", "Placemark")]
        rest += [(part, [*folders, *name], time) for part in reversed(inner)]


def _placemark(mark: Any, folders: Sequence[str], time: str | None) -> dict[str, Any]:
    """Returns the attributes and the geometry of a placemark."""
    shapely = library("shapely")
    row: dict[str, Any] = {"Name": next(iter(_texts(mark, "name")), None), "TimeStamp": time}
    row["Folder"] = "/".join(folders) or None
    shapes, edges = [], set()
    for part in mark.iter():
        kind = _tag(part)
        if kind in ("Data", "SimpleData") and part.get("name"):
            text = part.text if kind == "SimpleData" else "".join(_texts(part, "value"))
            row.setdefault(str(part.get("name")), (text or "").strip() or None)
        elif kind == "Polygon":
            edges |= {*part.iter()} - {part}
            sides = {_tag(side): [] for side in part}
            for side in part:
                sides[_tag(side)] += [_points(text) for text in _texts(side, "coordinates")]
            shapes.append(
                shapely.Polygon(sides["outerBoundaryIs"][0], sides.get("innerBoundaryIs"))
            )
        elif kind in ("LineString", "LinearRing", "Point") and part not in edges:
            make = shapely.Point if kind == "Point" else shapely.LineString
            shapes += [make(_points(text)) for text in _texts(part, "coordinates")]
    row["geometry"] = shapely.GeometryCollection(shapes) if len(shapes) > 1 else None
    return row | ({"geometry": shapes[0]} if len(shapes) == 1 else {})


def _points(text: str) -> list[tuple[float, float]]:
    pairs = (point.split(",") for point in re.sub(r"\s*,\s*", ",", text).split())
    return [(float(pair[0]), float(pair[1])) for pair in pairs]
