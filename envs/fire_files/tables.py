"""Reads the features of vector files: GeoPackage, shapefile, GeoJSON, KML, CSV, and folders."""

import gc
import json
import re
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from emberlink.envs.fire_files.dates import FOLDERS
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

_DEGREES = "EPSG:4326"
_OF_KML = ("Name", "Folder")
_ADDED = (*_OF_KML, "Description", "TimeStamp")


def read_table(path: Path, kind: str, layer: str | None) -> tuple[Any, list[str]]:
    """Reads the features of a file, or of all files in a folder.

    Args:
        path: a file, or a folder of files of one fire.
        kind: a format of `TABLES`.
        layer: `fire.layer`.

    Returns:
        A table of geopandas with a row per feature, whose index names the features in messages, and
        the names of the columns whose values stand outside the attributes, and may hold a date.
    """
    if kind != "folder":
        return _of_file(path, kind, layer)
    frames, outside = [], ["File"]
    for part in perimeter_files(path):
        try:
            form = find_format(part)
            if form not in TABLES:
                raise UserError("expected perimeters")
            frame, others = _of_file(part, form, layer)
        except UserError as error:
            raise UserError(f"{part.name}: {error}") from None
        lower = {n: str(n).lower() for n in frame.columns if n not in _ADDED}
        frame = frame.rename(columns=lower).rename(index=f"{part.name}: {{}}".format)
        if frames and (frame.crs is None) != (frames[0].crs is None):
            raise UserError(f"{part.name}: with and without projection; expected one in each file")
        frames.append(frame.assign(File=part.stem).to_crs(frames[0].crs if frames else frame.crs))
        outside += [lower.get(name, name) for name in others]
    return library("pandas").concat(frames), list(dict.fromkeys(outside))


def _of_file(path: Path, kind: str, layer: str | None) -> tuple[Any, list[str]]:
    geopandas, outside = library("geopandas"), []
    gc.disable()  # it takes two thirds of the time to parse a large text
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
    finally:
        gc.enable()
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
    shapes = _shapes([feature.get("geometry") for feature in features])
    rows = [f.get("properties") or {} for f in features]
    frame = library("geopandas").GeoDataFrame(rows, geometry=shapes, crs=crs)
    if crs == _DEGREES and len(frame) and abs(frame.total_bounds).max() > 360:
        frame = frame.set_crs(None, allow_override=True)  # not as GeoJSON is defined
    about = whole if whole["type"] == "FeatureCollection" else {}
    about = {**about, **(about.get("properties") or {}), **(about.get("metadata") or {})}
    taken = ("type", "name", *frame.columns)
    about = {k: v for k, v in about.items() if isinstance(v, str | int) and k not in taken}
    return frame.assign(**about), list(about)


def _shapes(geometries: Sequence[Any]) -> Sequence[Any]:
    """Returns geometries of GeoJSON; at once if all are polygons without holes, as circles are."""
    shapely = library("shapely.geometry")
    kinds = {g["type"] + str(len(g.get("coordinates", ()))) if g else "" for g in geometries}
    if kinds != {"Polygon1"}:
        return [shapely.shape(geometry) if geometry else None for geometry in geometries]
    rings = [np.array(geometry["coordinates"][0], float)[:, :2] for geometry in geometries]
    of = np.repeat(np.arange(len(rings)), [len(ring) for ring in rings])
    shapely = library("shapely")
    return shapely.polygons(shapely.linearrings(np.concatenate(rings), indices=of))


def _kml(path: Path, kind: str, layer: str | None) -> tuple[Any, list[str]]:
    """Reads placemarks; a folder's time holds for the placemarks in it."""
    rows: list[dict[str, Any]] = []
    for content in [path.read_bytes()] if kind == "kml" else _kml_in_archive(path):
        if b"\0" in content[:1000] or re.search(rb"<!(DOCTYPE|ENTITY)", content, re.IGNORECASE):
            raise UserError("a document type declaration or UTF-16; expected plain KML")
        root = ElementTree.fromstring(content)
        for element in root.iter():
            element.tag = str(element.tag).rpartition("}")[2]
        if root.tag != "kml":
            raise UserError(f"the first element is {root.tag[:40]!r}; expected KML")
        rows += [_placemark(mark, folders, time) for mark, folders, time in _placemarks(root)]
    if layer is not None:
        rows = [row for row in rows if layer in str(row["Folder"]).split(FOLDERS)]
    frame = library("geopandas").GeoDataFrame(rows, geometry="geometry", crs=_DEGREES)
    frame = frame.dropna(axis="columns", how="all")
    return frame, [name for name in _OF_KML if name in frame.columns]


def _kml_in_archive(path: Path) -> list[bytes]:
    try:
        with zipfile.ZipFile(path) as archive:
            parts = [part for part in archive.infolist() if part.filename.lower().endswith(".kml")]
            if not parts or sum(part.file_size for part in parts) > MAX_BYTES:
                raise UserError(
                    f"{len(parts)} .kml in it; expected one of {MAX_BYTES} bytes at most"
                )
            return [archive.read(part) for part in parts]
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
        raise UserError(f"{error}; expected KMZ") from None


def _placemarks(root: Any) -> Iterator[tuple[Any, list[str], str | None]]:
    """Yields each placemark, the names of the folders around it, and its time or theirs."""
    rest: list[tuple[Any, list[str], str | None]] = [(root, [], None)]
    while rest:
        element, folders, time = rest.pop()
        for part in element:
            if part.tag in ("TimeStamp", "TimeSpan"):
                time = part.findtext("when") or part.findtext("begin") or time
        if element.tag == "Placemark":
            yield element, folders, time
            continue
        inner = [part for part in element if part.tag in ("Document", "Folder", "Placemark")]
        folders = [*folders, *filter(None, [element.findtext("name")])]
        rest += [(part, folders, time) for part in reversed(inner)]


def _placemark(mark: Any, folders: Sequence[str], time: str | None) -> dict[str, Any]:
    """Returns the attributes and the geometry of a placemark."""
    shapely = library("shapely")
    row: dict[str, Any] = {"Name": mark.findtext("name"), "TimeStamp": time and time.strip()}
    row["Folder"] = FOLDERS.join(folders) or None
    row["Description"] = mark.findtext("description")
    for part in (*mark.iter("Data"), *mark.iter("SimpleData")):
        text = part.text if part.tag == "SimpleData" else part.findtext("value")
        row.setdefault(str(part.get("name")), (text or "").strip() or None)
    shapes, edges = [], set()
    for area in mark.iter("Polygon"):
        edges |= {*area.iter()}
        sides = [
            [_points(text) for side in area.iter(tag) for text in side.iter("coordinates")]
            for tag in ("outerBoundaryIs", "innerBoundaryIs")
        ]
        shapes.append(shapely.Polygon(sides[0][0], sides[1]))
    for tag, make in (
        ("LineString", "LineString"),
        ("LinearRing", "LineString"),
        ("Point", "Point"),
    ):
        found = [part for part in mark.iter(tag) if part not in edges]
        shapes += [
            getattr(shapely, make)(_points(at)) for p in found for at in p.iter("coordinates")
        ]
    shape = shapely.GeometryCollection(shapes) if len(shapes) > 1 else None
    return row | {"geometry": shapes[0] if len(shapes) == 1 else shape}


def _points(element: Any) -> list[tuple[float, float]]:
    pairs = (at.split(",") for at in re.sub(r"\s*,\s*", ",", element.text or "").split())
    return [(float(pair[0]), float(pair[1])) for pair in pairs]
