"""Generates damaged fire files and files of a wrong format from valid files."""

import json
import os
import shutil
import sqlite3
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import geopandas
import numpy as np
import rasterio
import shapely
from fire_files import (
    UTM,
    Ellipses,
    frame_of,
    points_text,
    raster_of,
    write_asc,
    write_tif,
)

FIRE = Ellipses()
TIMES = (60.0, 120.0, 180.0, 240.0, 300.0)
MINUTES = {"units": "minutes"}


@dataclass(frozen=True)
class Case:
    """Holds a file, its keys and the expected error."""

    name: str
    path: Path
    cause: str = ""
    """regular expression that the message matches"""
    keys: dict[str, Any] = field(default_factory=dict)
    whole: Path | None = None
    """whole file, if the damage may leave the fire unchanged"""


def wholes(folder: Path) -> dict[str, Path]:
    """Writes a valid file of each format."""
    folder.mkdir()
    times = raster_of(FIRE, 300.0, cells=40, cell=75.0)
    frame = frame_of(FIRE, TIMES)
    files = {
        "asc": write_asc(folder / "fire.asc", times, 75.0),
        "tif": write_tif(folder / "fire.tif", times.astype("float32"), 75.0),
        "deflated": write_tif(folder / "small.tif", times, 75.0, compress="deflate"),
        "npy": folder / "bank.npy",
        "bands": folder / "bank.tif",
    }
    fires = np.stack([np.where(times < 0, np.inf, times / 6).astype("float32")] * 3)
    np.save(files["npy"], fires)
    bands = np.where(np.isinf(fires), np.float32(-9999), fires)
    about = {"crs": None, "transform": rasterio.transform.from_origin(-0.5, 39.5, 1, 1)}
    write_tif(files["bands"], bands, 1.0, tags={"units": "steps"}, **about)
    for suffix in ("shp", "geojson", "gpkg"):
        files[suffix] = folder / f"fire.{suffix}"
        frame.to_file(files[suffix])
    for suffix in ("kml", "kmz"):
        files[suffix] = folder / f"fire.{suffix}"
        frame.to_crs("EPSG:4326").to_file(files[suffix], driver="LIBKML")
    files["txt"] = folder / "fire.txt"
    files["txt"].write_text(points_text(FIRE, 6040, points=24))
    return files


def keys_of(kind: str) -> dict[str, Any]:
    """Returns the keys with which a valid file is read."""
    return MINUTES if kind in ("asc", "tif", "deflated") else {}


def cases(folder: Path) -> Iterator[Case]:
    """Yields all cases."""
    good = wholes(folder / "whole")
    for make in (_no_files, _cut, _garbage, _other_kinds, _headers, _values, _rasters):
        yield from make(folder / make.__name__, good)
    yield from _tagged(folder / "_tagged", good)
    for make in (_banks, _tables, _shapes, _shapefiles, _json, _texts, _choices):
        yield from make(folder / make.__name__, good)


def _no_files(folder: Path, good: dict[str, Path]) -> Iterator[Case]:
    folder.mkdir()
    for suffix in ("asc", "tif", "shp", "geojson", "gpkg", "txt", "npy", "xyz", ""):
        name = f"none.{suffix}" if suffix else "none"
        yield Case(f"missing {suffix}", folder / name, "no such file")
        empty = folder / f"empty.{suffix}"
        empty.touch()
        yield Case(f"empty {suffix}", empty, "is empty")
        (folder / f"dir.{suffix}").mkdir()
        yield Case(f"folder {suffix}", folder / f"dir.{suffix}", "a folder")
        os.mkfifo(folder / f"pipe.{suffix}")
        yield Case(f"pipe {suffix}", folder / f"pipe.{suffix}", "no regular file")
        (folder / f"loop.{suffix}").symlink_to(folder / f"loop.{suffix}")
        yield Case(f"loop {suffix}", folder / f"loop.{suffix}", "cannot be read|no such file")
    for text in ("/vsicurl/http://localhost:9/fire.tif", "http://localhost:9/fire.geojson"):
        yield Case(text, Path(text), "no such file")
    yield Case("device", Path("/dev/zero"), "no regular file")
    yield Case("name too long", folder / ("x" * 300), "cannot be read")
    for suffix, source in (("zip", "shp"), ("gz", "tif"), ("kmz", "geojson")):
        path = folder / f"fire.{suffix}"
        shutil.copy(good[source], path)
        yield Case(f"archive {suffix}", path, "archive|expected KMZ")
    bomb = folder / "bomb.shp"
    bomb.write_bytes(b"PK\3\4" + bytes(1000))
    yield Case("zip named shp", bomb, "archive")


def _cut(folder: Path, good: dict[str, Path]) -> Iterator[Case]:
    """Yields files that are cut off at fractions of their length and near both ends."""
    for kind, source in good.items():
        content = source.read_bytes()
        size = len(content)
        lengths = {size * k // 10 for k in (1, 4, 7, 9)} | {1, 20, size - 60, size - 9}
        for length in sorted(length for length in lengths if 0 < length < size):
            path = _beside(folder / f"{kind}_{length}", source)
            path.write_bytes(content[:length])
            # A cut near the end of a text may remove nothing, or only the last digits.
            harmless = kind in ("asc", "txt", "geojson") and length >= size - 9
            text = kind == "txt"  # may end after any line
            yield Case(
                f"{kind} cut to {length} of {size}",
                path,
                "",
                keys_of(kind),
                source if harmless or text or kind in ("tif", "deflated", "bands") else None,
            )


def _tagged(folder: Path, good: dict[str, Path]) -> Iterator[Case]:
    """Yields GeoTIFFs with tags at the end that are cut off or overwritten."""
    folder.mkdir()
    whole = folder / "whole.tif"
    shutil.copy(good["tif"], whole)
    before = whole.stat().st_size
    with rasterio.open(whole, "r+") as dataset:
        dataset.update_tags(author="the tower")
    content = whole.read_bytes()
    for length in range(before, len(content), 9):
        path = folder / f"tagged_{length}.tif"
        path.write_bytes(content[:length])
        yield Case(f"tagged tif cut to {length}", path, "damaged|expected", MINUTES, whole)
    for tag in (33550, 33922):  # GeoPixelScale, GeoTiePoints
        at = content.rindex(struct.pack("<HH", tag, 12))
        for number, (offset, spoilt) in enumerate(
            ((0, b"\1"), (2, b"\xff"), (4, b"\0\0\0\0"), (8, b"\xff\xff\xff\x7f"), (4, b"\1"))
        ):
            path = folder / f"spoilt_{tag}_{number}.tif"
            where = at + offset
            path.write_bytes(content[:where] + spoilt + content[where + len(spoilt) :])
            # The second tag holds the geographic position, which does not change the grid.
            same = whole if tag == 33922 else None
            yield Case(f"tif with tag {tag} spoilt, {number}", path, "", MINUTES, same)
    without = write_tif(folder / "no_place.tif", raster_of(FIRE, 300.0), transform=None)
    yield Case("tif without a geotransform", without, "no geotransform", MINUTES)


def _beside(folder: Path, source: Path) -> Path:
    """Copies a file and the files beside it to a new folder."""
    folder.mkdir(parents=True)
    for part in source.parent.glob(f"{source.stem}.*"):
        if part.suffix in (".shp", ".shx", ".dbf", ".prj", ".cpg") or part == source:
            shutil.copy(part, folder / part.name)
    return folder / source.name


def _garbage(folder: Path, good: dict[str, Path]) -> Iterator[Case]:
    """Yields random bytes, prose, and files with overwritten bytes."""
    folder.mkdir()
    random = np.random.default_rng(20_250_923)
    for kind, source in good.items():
        for number, size in enumerate((1000, 30_000)):
            path = folder / f"{kind}_{number}{source.suffix}"
            path.write_bytes(random.bytes(size))
            yield Case(f"{size} random bytes as {kind}", path, "begins with|expected")
        text = folder / f"{kind}_text{source.suffix}"
        text.write_text("The fire was first seen from the tower at noon.\n" * 40)
        yield Case(f"prose as {kind}", text, "begins with")
        content = bytearray(source.read_bytes())
        content[:64] = random.bytes(64)
        head = folder / f"{kind}_head{source.suffix}"
        head.write_bytes(content)
        yield Case(f"{kind} with another beginning", head, "begins with|expected")
        content = bytearray(source.read_bytes())
        if kind in ("asc", "txt", "geojson"):
            for number, share in enumerate((300, 400, 500, 600, 700, 998)):
                at = len(content) * share // 1000
                spoilt = content.copy()
                spoilt[at : at + 8] = b"\0\xff\x80@#\x01!~"
                path = folder / f"{kind}_spoilt_{number}{source.suffix}"
                path.write_bytes(spoilt)
                whole = source if kind == "txt" and number < 5 else None  # in skipped lines
                yield Case(f"{kind} with binary at {at}", path, "", keys_of(kind), whole)


def _other_kinds(folder: Path, good: dict[str, Path]) -> Iterator[Case]:
    """Yields each format under the file name of another format."""
    folder.mkdir()
    for kind, source in good.items():
        for other in (".asc", ".tif", ".geojson", ".npy"):
            if other != source.suffix:
                path = folder / f"{kind}_as{other}"
                shutil.copy(source, path)
                yield Case(f"{kind} as {other}", path, "begins with|archive", MINUTES)


def _headers(folder: Path, good: dict[str, Path]) -> Iterator[Case]:
    """Yields wrong headers of ESRI ASCII."""
    folder.mkdir()
    lines = good["asc"].read_text().splitlines()
    invalid: dict[str, tuple[Callable[[list[str]], list[str]], str]] = {
        "too few columns": (lambda a: ["NCOLS 39", *a[1:]], "40 numbers.*ncols=39"),
        "columns and rows swapped": (lambda a: ["NCOLS 20", "NROWS 80", *a[2:]], "nrows=80"),
        "too few rows": (lambda a: [a[0], "NROWS 39", *a[2:]], "40 rows.*nrows=39"),
        "too many rows": (lambda a: [a[0], "NROWS 41", *a[2:]], "40 rows.*nrows=41"),
        "a billion columns": (lambda a: ["NCOLS 1000000000", *a[1:]], "1000000000 x 40"),
        "1e300 columns": (lambda a: ["NCOLS 1e300", *a[1:]], "whole number"),
        "half a column": (lambda a: ["NCOLS 39.5", *a[1:]], "whole number"),
        "negative rows": (lambda a: [a[0], "NROWS -40", *a[2:]], "whole number"),
        "columns in words": (lambda a: ["NCOLS forty", *a[1:]], "line 1: .*ncols"),
        "columns twice": (lambda a: [a[0], *a], "line 2: .*once"),
        "no NCOLS": (lambda a: a[1:], "ncols"),
        "no CELLSIZE": (lambda a: [*a[:4], *a[5:]], "cellsize"),
        "no XLLCORNER": (lambda a: [*a[:2], *a[3:]], "xllcorner"),
        "both corners": (lambda a: [*a[:2], "XLLCENTER 3", *a[2:]], "xllcenter"),
        "cells of -30": (lambda a: [*a[:4], "CELLSIZE -30", *a[5:]], "above 0"),
        "infinite cells": (lambda a: [*a[:4], "CELLSIZE inf", *a[5:]], "above 0"),
        "corner beyond the Earth": (lambda a: [*a[:2], "XLLCORNER 1e300", *a[3:]], "Earth"),
        "unknown key": (lambda a: [*a[:5], "BYTEORDER LSB", *a[5:]], "byteorder"),
        "NODATA in words": (lambda a: [*a[:5], "NODATA_VALUE none", *a[6:]], "nodata_value"),
        "header alone": (lambda a: a[:6], "nrows=40"),
        "header cut": (lambda a: a[:3], "nrows|cellsize"),
        "commas": (lambda a: [*a[:6], *(row.replace(" ", ",") for row in a[6:])], "row"),
        "a row of another length": (lambda a: [*a[:20], a[20] + " 7", *a[21:]], "41 at row 15"),
        "a row missing": (lambda a: [*a[:20], *a[21:]], "39 rows"),
        "all in one row": (lambda a: [*a[:6], " ".join(a[6:])], "1600"),
        "rows wrapped": (lambda a: [*a[:6], *" ".join(a[6:]).replace(" ", "\n").split()], "1600"),
    }
    for name, (spoil, cause) in invalid.items():
        path = folder / f"{name.replace(' ', '_')}.asc"
        path.write_text("\n".join([*spoil(lines), ""]))
        yield Case(f"asc: {name}", path, cause, MINUTES)
    for token in ("x", "3..", "0x10", "1,5", "#"):
        row = lines[20].split()
        row[7] = token
        path = folder / f"token_{len(list(folder.iterdir()))}.asc"
        path.write_text("\n".join([*lines[:20], " ".join(row), *lines[21:], ""]))
        yield Case(f"asc: a value {token}", path, "row 14, column 8", MINUTES)


def _values(folder: Path, good: dict[str, Path]) -> Iterator[Case]:
    """Yields numbers that are no times, or no times of a spreading fire."""
    folder.mkdir()
    times = raster_of(FIRE, 300.0, cells=40, cell=75.0)
    single = np.full_like(times, -9999.0)
    single[20, 20] = 5.0
    invalid = {
        "NODATA everywhere": (np.full_like(times, -9999.0), "no cell burns"),
        "-1 everywhere": (np.full_like(times, -1.0), "no cell burns"),
        "NaN everywhere": (np.full_like(times, np.nan), "no cell burns"),
        "infinite everywhere": (np.full_like(times, np.inf), "no cell burns"),
        "a fire of one cell": (single, "single cell"),
        "all cells at once": (np.where(times >= 0, 3.0, times), "at once"),
        "zero everywhere": (np.zeros_like(times), "at once"),
        "negative times": (np.where(times >= 0, -5.0 - times, times), "not an arrival time"),
        "a negative time": (np.where(single == 5, -0.5, times), "-0.5 is not an"),
        "a time of 1e20": (np.where(single == 5, 1e20, times), "not an arrival time"),
        "another NODATA": (np.where(times < 0, -32768.0, times), "-32768"),
    }
    for name, (values, cause) in invalid.items():
        stem = str(folder / name.replace(" ", "_"))
        yield Case(f"asc: {name}", write_asc(Path(f"{stem}.asc"), values, 75.0), cause, MINUTES)
        yield Case(f"tif: {name}", write_tif(Path(f"{stem}.tif"), values, 75.0), cause, MINUTES)
        if name == "all cells at once":  # a bank may have few steps
            continue
        bank = np.stack([np.where(times < 0, np.inf, times / 6), values])
        np.save(f"{stem}.npy", bank)
        yield Case(f"npy: {name}", Path(f"{stem}.npy"), f"fire 1.*{cause}")
        path = write_tif(
            Path(f"{stem}_bank.tif"),
            np.stack([np.where(times < 0, times, times / 6), values]),
            tags={"units": "steps"},
            crs=None,
        )
        yield Case(f"bands: {name}", path, f"fire 1.*{cause}")


def _rasters(folder: Path, good: dict[str, Path]) -> Iterator[Case]:
    """Yields GeoTIFFs without arrival times or without a valid georeference."""
    folder.mkdir()
    times = raster_of(FIRE, 300.0, cells=40, cell=75.0).astype("float32")
    affine = rasterio.Affine
    invalid: dict[str, tuple[np.ndarray, dict[str, Any], str]] = {
        "three bands": (np.stack([times] * 3), {}, "3 bands"),
        "complex": (times.astype("complex64"), {"nodata": None}, "complex"),
        "a picture": (np.full((40, 40), 7, "uint8"), {"nodata": None}, "picture"),
        "unknown units": (times, {}, "units"),
        "degrees without a projection": (times, _degrees(), "fire.crs"),
        "degrees that are none": (times, {"crs": "EPSG:4326"}, "not degrees"),
        "beyond the Earth": (times, {"transform": affine(75, 0, 1e200, 0, -75, 0)}, "Earth"),
        "half the world": (
            times,
            {"crs": "EPSG:4326", "transform": affine(4, 0, -80, 0, -4, 80)},
            "160 x 160 degrees.*fire.crs",
        ),
        "no zone": (
            times,
            {"crs": "EPSG:4326", "transform": affine(1e-3, 0, 10, 0, -1e-3, -89)},
            "zone",
        ),
    }
    for name, (values, about, cause) in invalid.items():
        path = write_tif(folder / f"{name.replace(' ', '_')}.tif", values, 75.0, **about)
        yield Case(f"tif: {name}", path, cause, {} if name == "unknown units" else MINUTES)
    huge = folder / "huge.tif"
    about = {"height": 40_000, "width": 40_000, "sparse_ok": True, "tiled": True}
    _sparse(huge, **about)
    yield Case("tif: 40,000 x 40,000", huge, "at most", MINUTES)
    wide = _sparse(folder / "wide.tif", height=1, width=2_000_000, tiled=False, sparse_ok=True)
    yield Case("tif: a row of 2,000,000", wide, "no cell burns", MINUTES)
    for name, crs in (
        ("unknown", "EPSG:999999"),
        ("words", "the usual one"),
        ("degrees", "EPSG:4326"),
    ):
        yield Case(f"tif: crs {name}", good["tif"], "EPSG", {**MINUTES, "crs": crs})


def _degrees() -> dict[str, Any]:
    return {"crs": None, "transform": rasterio.Affine(7e-4, 0, -117.2, 0, -7e-4, 36.1)}


def _sparse(path: Path, **about: Any) -> Path:
    settings = {"driver": "GTiff", "count": 1, "dtype": "float32", "nodata": -9999.0, "crs": UTM}
    transform = rasterio.transform.from_origin(500_000, 4_000_000, 30, 30)
    with rasterio.open(path, "w", transform=transform, **settings, **about):
        pass
    return path


def _banks(folder: Path, good: dict[str, Path]) -> Iterator[Case]:
    """Yields NumPy files without fires."""
    folder.mkdir()
    fires = np.load(good["npy"])
    invalid: dict[str, tuple[np.ndarray, str]] = {
        "no fires": (fires[:0], "shape"),
        "one number": (np.array(3.0), "shape"),
        "a row": (fires[0, 0], "shape"),
        "four dimensions": (fires[None], "shape"),
        "tiny": (fires[:, :5, :5], "5 x 5"),
        "long": (np.ones((1, 300, 10), "float32"), "300 x 10"),
        "complex": (fires.astype("complex64"), "complex"),
        "text": (fires.astype("U8"), "type"),
        "bool": (fires > 3, "bool"),
        "dates": (np.zeros((2, 9, 9), "datetime64[s]"), "datetime"),
        "records": (np.zeros((2, 9, 9), [("a", "f4")]), "type"),
    }
    for name, (array, cause) in invalid.items():
        path = folder / f"{name.replace(' ', '_')}.npy"
        np.save(path, array)
        yield Case(f"npy: {name}", path, cause)
    pickled = folder / "pickled.npy"
    np.save(pickled, np.array([{"a": 1}, None], dtype=object), allow_pickle=True)
    yield Case("npy: pickled", pickled, "expected")
    header = np.lib.format.header_data_from_array_1_0(fires)
    for shape in ((3, 10**6, 10**6), (10**12, 30, 30), (-1, 30, 30)):
        path = folder / f"promises_{len(list(folder.iterdir()))}.npy"
        with path.open("wb") as file:
            np.lib.format.write_array_header_1_0(file, {**header, "shape": shape})
            file.write(bytes(1000))
        yield Case(f"npy: promises {shape}", path, "expected")
    archive = folder / "archive.npy"
    np.savez(folder / "archive.npz", fires=fires)
    (folder / "archive.npz").rename(archive)
    yield Case("npz as npy", archive, "archive")


def _write(frame: geopandas.GeoDataFrame, path: Path) -> Path:
    frame.to_file(path)
    return path


def _tables(folder: Path, good: dict[str, Path]) -> Iterator[Case]:
    """Yields columns without valid times, in each format of perimeters."""
    folder.mkdir()
    frame = frame_of(FIRE, TIMES)
    dated = ["2020-08-19T12:00", "2020-08-19T13:00", "2020-08-19T14:00", "soon", "2020-08-20"]
    zones = ["2020-08-19T12:00Z", "2020-08-19T13:00", *dated[2:3] * 3]
    date = {"date": [f"2020-08-19T{hour}:00" for hour in range(12, 17)]}
    invalid: dict[str, tuple[dict[str, Any], str, dict[str, Any]]] = {
        "no column": ({}, "fire.time_field", {}),
        "no known column": ({"size": list(TIMES)}, "fire.time_field", {}),
        "another column": ({"size": list(TIMES)}, "no column 'when'", {"time_field": "when"}),
        "no units": ({"size": list(TIMES)}, "fire.units", {"time_field": "size"}),
        "other units": ({"Elapsed_Mi": list(TIMES)}, "minutes", {"units": "hours"}),
        "a time missing": ({"Elapsed_Mi": [60.0, None, *TIMES[2:]]}, "feature 1", {}),
        "no time at all": ({"Elapsed_Mi": [np.nan] * 5}, "feature 0", {}),
        "a negative time": ({"Elapsed_Mi": [60.0, -3.0, *TIMES[2:]]}, "feature 1", {}),
        "a time of 1e15": ({"Elapsed_Mi": [60.0, 1e15, *TIMES[2:]]}, "feature 1", {}),
        "one time": ({"Elapsed_Mi": [60.0] * 5}, "one perimeter", {}),
        "backwards": ({"Elapsed_Mi": list(TIMES)[::-1]}, "backwards", {}),
        "shuffled": ({"Elapsed_Mi": [60.0, 240.0, 120.0, 180.0, 300.0]}, "backwards", {}),
        "words": ({"date": ["noon", "one", "two", "three", "four"]}, "feature 0", {}),
        "a word": ({"date": dated}, "feature 3.*soon", {}),
        "a zone and none": ({"date": zones}, "time zone", {}),
        "no year": ({"Month": [4] * 5, "Day": [1] * 5, "Hour": [1200] * 5}, "Month, Day", {}),
        "hour 2575": ({"DATE_": ["2015-08-19"] * 5, "TIME_": ["2575"] * 5}, "TIME_=2575", {}),
        "start in words": (date, "fire.start=noon", {"start": "noon"}),
        "start as a number": (date, "fire.units", {"start": 60.0}),
        "start beyond all time": (date, "no fire spreads", {"start": 1e300, "units": "days"}),
        "start in the year 12000": (date, "no fire spreads", {"start": 4e6, "units": "days"}),
        "before year 1": ({"date": ["0001-01-01T00:00:00+14:00"] * 5}, "date.*year 1", {}),
        "milliseconds of no year": ({"date": [1e18 + t for t in TIMES]}, "date='1e\\+18'", {}),
        "end before start": (
            {"Elapsed_Mi": list(TIMES)},
            "after the start",
            {"start": 200.0, "end": 100.0},
        ),
        "after the fire": (
            {"Elapsed_Mi": list(TIMES)},
            "no fire spreads",
            {"start": 300.0, "end": 900.0},
        ),
        "before the fire": (date, "no fire spreads", {"end": "2020-08-19T11:00"}),
        "a date for minutes": ({"Elapsed_Mi": list(TIMES)}, "minutes", {"start": "2020-08-19"}),
    }
    for number, (name, (columns, cause, keys)) in enumerate(invalid.items()):
        table = geopandas.GeoDataFrame(columns, geometry=frame.geometry, crs=UTM)
        path = folder / f"{name.replace(' ', '_')}.{('shp', 'geojson', 'gpkg')[number % 3]}"
        yield Case(f"table: {name}", _write(table, path), cause, keys)


def _shapes(folder: Path, good: dict[str, Path]) -> Iterator[Case]:
    """Yields geometries that are not perimeters."""
    folder.mkdir()
    frame = frame_of(FIRE, TIMES)
    point, shape = shapely.Point(5e5, 4e6), frame.geometry[2]
    line = shape.boundary
    opened = shapely.LineString(list(line.coords)[: len(line.coords) // 2])
    flat = shapely.LineString([(5e5, 4e6), (5.1e5, 4e6), (5e5, 4e6)])
    far = shapely.transform(shape, lambda at: at * 1e200)
    invalid: dict[str, tuple[list[Any], str]] = {
        "points": ([point] * 5, "Point"),
        "an open line": ([*(g.boundary for g in frame.geometry[:4]), opened], "not closed"),
        "all open": ([opened] * 5, "not closed"),
        "a flat line": ([*(g.boundary for g in frame.geometry[:4]), flat], "no area|not closed"),
        "no geometry": ([*frame.geometry[:4], None], "no geometry"),
        "an empty one": ([*frame.geometry[:4], shapely.Polygon()], "no geometry"),
        "nothing": ([None] * 5, "geometr"),
        "the same": ([shape] * 5, "no fire spreads"),
        "beyond the Earth": ([*frame.geometry[:4], far], "Earth|geometr|expected"),
    }
    for name, (shapes, cause) in invalid.items():
        table = geopandas.GeoDataFrame({"Elapsed_Mi": list(TIMES)}, geometry=shapes, crs=UTM)
        for suffix in ("shp", "geojson", "gpkg"):
            path = folder / f"{name.replace(' ', '_')}.{suffix}"
            yield Case(f"{suffix}: {name}", _write(table, path), cause)
    degrees = frame.to_crs("EPSG:4326").set_crs(None, allow_override=True)
    for suffix in ("shp", "gpkg"):
        path = _write(degrees, folder / f"degrees.{suffix}")
        yield Case(f"{suffix}: degrees without a projection", path, "fire.crs")
    several = folder / "several.gpkg"
    for layer in ("one", "two"):
        frame.to_file(several, layer=layer)
    yield Case("gpkg: two layers", several, "fire.layer, one of one, two")
    yield Case("gpkg: no such layer", several, "'three'", {"layer": "three"})
    table = folder / "table.gpkg"
    with sqlite3.connect(table) as database:
        database.execute("create table fires (t real)")
    database.close()
    yield Case("gpkg: a database of something else", table, "layer|expected")
    yield Case("empty layer", _write(frame.iloc[:0], folder / "none.gpkg"), "no feature")


def _shapefiles(folder: Path, good: dict[str, Path]) -> Iterator[Case]:
    """Yields shapefiles with parts that are missing, cut off, or taken from another file."""
    for suffix in (".shx", ".dbf"):
        path = _beside(folder / f"without{suffix}", good["shp"])
        path.with_suffix(suffix).unlink()
        yield Case(f"shp without {suffix}", path, f"fire{suffix} is missing")
        path = _beside(folder / f"part{suffix}", good["shp"])
        yield Case(f"{suffix} in place of shp", path.with_suffix(suffix), "expected the .shp")
        for share in (2, 3, 8):
            path = _beside(folder / f"cut_{share}{suffix}", good["shp"])
            part = path.with_suffix(suffix)
            part.write_bytes(part.read_bytes()[: part.stat().st_size * (share - 1) // share])
            yield Case(f"shp with {suffix} cut by 1/{share}", path, f"fire{suffix} has")
        path = _beside(folder / f"empty{suffix}", good["shp"])
        path.with_suffix(suffix).write_bytes(b"")
        yield Case(f"shp with an empty {suffix}", path, f"fire{suffix} has 0")
        path = _beside(folder / f"dir{suffix}", good["shp"])
        path.with_suffix(suffix).unlink()
        path.with_suffix(suffix).mkdir()
        yield Case(f"shp with a folder as {suffix}", path, "a folder")
    path = _beside(folder / "other", good["shp"])
    frame_of(FIRE, TIMES[:3]).to_file(folder / "three.shp")
    shutil.copy(folder / "three.dbf", path.with_suffix(".dbf"))
    yield Case("shp with another's dbf", path, "3 records.* 5")
    path = _beside(folder / "count", good["shp"])
    part = path.with_suffix(".dbf")
    content = bytearray(part.read_bytes())
    content[4:8] = struct.pack("<I", 10**9)
    part.write_bytes(content)
    yield Case("dbf that promises 1e9 records", path, "cut off")
    path = _beside(folder / "prj", good["shp"])
    path.with_suffix(".prj").write_text("PROJCS[nonsense")
    yield Case("shp with a prj of nonsense", path, "fire.prj.*no projection")
    yield Case("… and fire.crs", path, "fire.prj.*no projection", {"crs": UTM})
    path = folder / "prj.asc"
    shutil.copy(good["asc"], path)
    path.with_suffix(".prj").write_bytes(b"\xff\xfe\x00 of nothing")
    yield Case("asc with a prj of nonsense", path, "prj.prj.*no projection", MINUTES)


def _json(folder: Path, good: dict[str, Path]) -> Iterator[Case]:
    folder.mkdir()
    text = good["geojson"].read_text()
    whole = json.loads(text)
    nested = '{"type": "FeatureCollection", "features": ' + "[" * 1_000_000
    invalid = {
        "a million levels": nested,
        "objects a million deep": '{"a":' * 1_000_000,
        "no features": json.dumps({**whole, "features": []}),
        "features that are none": json.dumps({**whole, "features": [1, 2, 3]}),
        "features in words": json.dumps({**whole, "features": "many"}),
        "another type": json.dumps({**whole, "type": "Topology"}),
        "no type": json.dumps({"features": whole["features"]}),
        "geometries alone": json.dumps(whole["features"][0]["geometry"]),
        "NaN": text.replace("[ [", "[ [ NaN,", 1).replace("[[", "[[ NaN,", 1),
        "two in one": text + text,
        "a comma too many": text.replace("}", "},", 1),
        "UTF-16": text.encode("utf-16").decode("latin-1"),
        "coordinates in words": text.replace("500", '"500"', 1),
        "rings of a point": json.dumps(_with_ring(whole, [[5e5, 4e6]] * 4)),
        "rings of one number": json.dumps(_with_ring(whole, [[5e5]] * 4)),
        "rings of nothing": json.dumps(_with_ring(whole, [])),
    }
    for name, content in invalid.items():
        path = folder / f"{name.replace(' ', '_')}.geojson"
        path.write_text(content, encoding="latin-1" if name == "UTF-16" else "utf-8")
        yield Case(f"geojson: {name}", path, "expected|begins with")


def _with_ring(whole: dict[str, Any], ring: list[Any]) -> dict[str, Any]:
    first, *others = whole["features"]
    spoilt = {**first, "geometry": {"type": "Polygon", "coordinates": [ring]}}
    return {**whole, "features": [spoilt, *others]}


def _texts(folder: Path, good: dict[str, Path]) -> Iterator[Case]:
    """Yields wrong versions of the paper's text."""
    folder.mkdir()
    lines = good["txt"].read_text().splitlines()
    invalid = {
        "too short": (lines[:5999], "5999 lines"),
        "only what is skipped": (lines[:6000], "6000 lines"),
        "two numbers": ([*lines[:6010], "1.0,2.0", *lines[6011:]], "line 6011.*2 numbers"),
        "four numbers": ([*lines[:6010], "1,2,3,4,", *lines[6011:]], "line 6011.*4 numbers"),
        "words": ([*lines[:6010], "a,b,c,", *lines[6011:]], "line 6011"),
        "an empty number": ([*lines[:6010], "1,,3,", *lines[6011:]], "line 6011"),
        "semicolons": ([line.replace(",", ";") for line in lines], "begins with|line"),
        "infinite": ([*lines[:6010], "1e999,2,3,", *lines[6011:]], "line 6011"),
        "all off the map": (["900,900,1,"] * 6010, "no point"),
        "no points": (["1,1,1,", *[""] * 6009], "no point|no fire"),
        "a front that stands": ([lines[0]] * 6010, "once|spreads"),
    }
    for name, (content, cause) in invalid.items():
        path = folder / f"{name.replace(' ', '_')}.txt"
        path.write_text("\n".join([*content, ""]))
        yield Case(f"txt: {name}", path, cause)


def _choices(folder: Path, good: dict[str, Path]) -> Iterator[Case]:
    """Yields valid files with keys that do not fit them."""
    for keys, cause in (
        ({"start": 400.0}, "no fire spreads"),
        ({"end": 0.0}, "after the start"),
        ({"start": 100.0, "end": 100.0}, "after the start"),
        ({"start": -500.0, "end": -400.0}, "no fire spreads"),
        ({"start": "2020-08-19"}, "expected a number"),
        ({"minutes_per_step": 1e-9}, "no fire spreads"),
    ):
        for kind in ("asc", "tif"):
            yield Case(f"{kind}: {keys}", good[kind], cause, {**MINUTES, **keys})
    steps = {"units": "steps", "minutes_per_step": 1.0}
    yield Case("steps and minutes", good["asc"], "minutes_per_step", steps)
    for kind in ("npy", "bands"):
        yield Case(f"{kind}: minutes", good[kind], "minutes_per_step", {"minutes_per_step": 1.0})
        yield Case(f"{kind}: after it", good[kind], "no fire spreads", {"start": 900.0})
