"""Writes fires with known arrival times in the file formats of other programs."""

import math
import re
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import geopandas
import numpy as np
import rasterio
import shapely
from rasterio.transform import from_origin

from emberlink.envs.fire_files.reader import read_with_summary
from emberlink.trainers.config.compose import resolve

CELL = 30.0
CORNER = 500_000.0, 4_000_000.0
UTM = "EPSG:32611"


@dataclass(frozen=True)
class Ellipses:
    """Models elliptical fires from points. The front grows linearly in time; metres and minutes."""

    origins: Sequence[tuple[float, float]] = ((1500.0, 1300.0),)
    head: float = 4.0
    """rate of spread of the head, metres per minute"""
    breadth: float = 2.0
    """length-to-breadth ratio"""
    azimuth: float = 40.0
    """direction of the head, degrees counter-clockwise from +x"""

    @property
    def axes(self) -> tuple[float, float, float]:
        """Returns half length, half breadth and shift of the ellipse after one minute, metres."""
        e = math.sqrt(self.breadth**2 - 1) / self.breadth
        back = self.head * (1 - e) / (1 + e)
        return (self.head + back) / 2, (self.head + back) / 2 / self.breadth, (self.head - back) / 2

    def arrival(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Solves ((along - c t) / a)² + (across / b)² = t² for t, minutes."""
        a, b, c = self.axes
        turn = math.radians(self.azimuth)
        times = []
        for x0, y0 in self.origins:
            along = (x - x0) * math.cos(turn) + (y - y0) * math.sin(turn)
            across = (y - y0) * math.cos(turn) - (x - x0) * math.sin(turn)
            square = a**2 - c**2
            root = np.sqrt((along * c) ** 2 + square * (along**2 + (across * a / b) ** 2))
            times.append((-along * c + root) / square)
        return np.min(times, axis=0)

    def perimeter(self, time: float, points: int = 90) -> shapely.Geometry:
        """Returns the area burnt by a time."""
        a, b, c = self.axes
        angle = np.linspace(0, 2 * np.pi, points, endpoint=False)
        along, across = (c + a * np.cos(angle)) * time, b * np.sin(angle) * time
        turn = math.radians(self.azimuth)
        x = along * math.cos(turn) - across * math.sin(turn)
        y = along * math.sin(turn) + across * math.cos(turn)
        rings = [np.stack([x + x0, y + y0], 1) for x0, y0 in self.origins]
        return shapely.union_all([shapely.Polygon(ring) for ring in rings])


def raster_of(fire: Ellipses, until: float, cells: int = 100, cell: float = CELL) -> np.ndarray:
    """Returns arrival times at the centres of cells, north up; -9999 after `until`."""
    at = (np.arange(cells) + 0.5) * cell
    times = fire.arrival(at[None, :], at[::-1, None])
    return np.where(times <= until, times, -9999.0)


def write_asc(path: Path, times: np.ndarray, cell: float = CELL, **header: object) -> Path:
    """Writes ESRI ASCII as FARSITE does."""
    keys = {"NCOLS": times.shape[1], "NROWS": times.shape[0], "XLLCORNER": CORNER[0]}
    keys |= {"YLLCORNER": CORNER[1], "CELLSIZE": cell, "NODATA_VALUE": -9999.0, **header}
    lines = [f"{key} {value}" for key, value in keys.items() if value is not None]
    rows = [" ".join(repr(float(value)) for value in row) for row in times]
    path.write_text("\n".join([*lines, *rows, ""]))
    return path


def write_tif(path: Path, times: np.ndarray, cell: float = CELL, **about: object) -> Path:
    """Writes a GeoTIFF of [rows, columns] or [bands, rows, columns]."""
    bands = times[None] if times.ndim == 2 else times
    tags, (count, height, width) = about.pop("tags", {}), bands.shape
    north = from_origin(CORNER[0], CORNER[1] + cell * height, cell, cell)
    settings = {"driver": "GTiff", "count": count, "height": height, "width": width, "crs": UTM}
    settings |= {"dtype": bands.dtype, "nodata": -9999.0, "transform": north, **about}
    with rasterio.open(path, "w", **settings) as dataset:
        dataset.write(bands)
        dataset.update_tags(**tags)
    return path


def frame_of(
    fire: Ellipses, times: Sequence[float], kind: str = "polygon"
) -> geopandas.GeoDataFrame:
    """Returns perimeters at some elapsed minutes, in the coordinates of the rasters."""
    shapes = [shapely.transform(fire.perimeter(time), lambda at: at + CORNER) for time in times]
    return geopandas.GeoDataFrame(
        {"Elapsed_Mi": np.array(times, float)},
        geometry=[KINDS[kind](shape) for shape in shapes],
        crs=UTM,
    )


def squares(
    *sides: float, at: tuple[float, float] = (0, 0), **columns: object
) -> geopandas.GeoDataFrame:
    """Returns concentric squares with the given sides in metres."""
    middle = np.array(CORNER) + at
    boxes = [shapely.box(*(middle - side / 2), *(middle + side / 2)) for side in sides]
    return geopandas.GeoDataFrame(columns, geometry=boxes, crs=UTM)


KINDS = {
    "polygon": lambda shape: shape,
    "multipolygon": lambda shape: shapely.MultiPolygon(shapely.get_parts([shape]).tolist()),
    "line": lambda shape: shape.boundary,
    "multiline": lambda shape: _in_parts(shape.boundary),
    "collection": lambda shape: shapely.GeometryCollection(
        [shapely.force_3d(shape, 7.0), shapely.force_3d(shape.centroid, 7.0)]
    ),
}
"""conversion of a perimeter to a kind of geometry"""


def _in_parts(line: shapely.Geometry) -> shapely.Geometry:
    parts = []
    for part in getattr(line, "geoms", [line]):
        at = list(part.coords)
        third = len(at) // 3
        parts += [at[: third + 1], at[third : 2 * third + 1][::-1], at[2 * third :]]
    return shapely.MultiLineString(parts)


def fires_in(config: Any, grid: tuple[int, int], horizon: int) -> Any:
    """Returns the fires of a file, [fires, X, Y]."""
    return read_with_summary(config, grid, horizon)[0]


def keys_in(message: str) -> list[str]:
    """Returns the first keys that a message prints after `expected`, as a shell passes them on."""
    tail = message.partition("; expected ")[2]
    found = re.findall(r"""'fire\.[^']*'|fire\.\w+=(?:"[^"]*"|[^\s,;]+)""", tail)
    count = 2 if found and "fire.incident_field" in found[0] else 1
    return [shlex.split(text)[0] for text in found[:count]]


def answered(path: Path, keys: dict[str, Any], *, questions: int = 4) -> tuple:
    """Reads a file and gives the keys that its questions print.

    Returns the fires on 20 x 20 cells, what `read:` says, and the questions in one line each;
    without fires if a question prints no keys, or after a number of questions.
    """
    given, asked = {f"fire.{key}": value for key, value in keys.items()}, []
    printed: dict[str, str] = {}
    while len(asked) < questions:
        texts = ["fire=file", "fire.ring_width=null", *map("=".join, printed.items())]
        config = resolve("independent", texts, **given, **{"fire.path": str(path)}).fire
        try:
            return *read_with_summary(config, (20, 20), 100), asked
        except ValueError as error:
            asked.append(text := str(error))
        assert "\n" not in text
        assert path.name in text
        assert asked.count(text) == 1
        if not (more := keys_in(text)):
            break
        printed |= {key: value for key, _, value in (item.partition("=") for item in more)}
        given = {key: value for key, value in given.items() if key not in printed}
    return None, "", asked


def points_text(fire: Ellipses, lines: int, skipped: int = 6000, points: int = 90) -> str:
    """Returns the paper's text: a line per iteration, the same front until line `skipped`."""
    rows = []
    for line in range(lines):
        time = 60 + max(line - skipped, 0)
        at = shapely.get_coordinates(fire.perimeter(time, points).boundary) / 100 + 29 / 3
        rows.append("".join(f"{x:.3f},{y:.3f},1.0," for x, y in at))
    return "\n".join([*rows, ""])
