"""Reads rasters of arrival times: ESRI ASCII, GeoTIFF, NetCDF, arrays of states, banks, points."""

import itertools
import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from emberlink.envs.config import SIDES
from emberlink.envs.fire_files.config import Clock, FileFireConfig
from emberlink.envs.fire_files.dates import in_utc, parse_dates
from emberlink.envs.fire_files.files import check_prj, first_line, forest_grids, library
from emberlink.envs.fire_files.grid import Raster, beginnings, far_apart
from emberlink.envs.fire_files.projection import MAX_CELLS, Affine, choose_plane, warped
from emberlink.envs.fire_files.times import in_order
from emberlink.envs.fire_files.values import arrival, check_spreads, first_burning, unit_of
from emberlink.envs.utils.errors import UserError

MAX_BANK = 300_000_000
"""Maximum number of cells of all fires of a bank: 1.2 GB."""
_DRIVERS = {"tif": "GTiff", "nc": "netCDF", "asc": "AAIGrid"}
_HEADER = re.compile(r"\s*(?!nan|inf)[a-z]", re.IGNORECASE)  # a line of ESRI ASCII
_NORTH_UP = (1.0, 0.0, 0.0, 0.0, -1.0)
_SIDE = 30  # cells along a side of the paper's map
_SKIPPED = 6000  # lines of the paper's text before step 0
_PLUS = ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1))


def read_raster(path: Path, kind: str, config: FileFireConfig) -> tuple[list[Raster], int | None]:
    """Reads the fire of a raster, or the fires of a bank and the steps for which it was written."""
    if kind == "points":
        return [_front_points(path, config)], None
    if kind in ("npy", "grids"):
        maps = _grids(path) if kind == "grids" else _numpy(path)
        if config.kind == "masks":
            return [_of_states(maps, (*_NORTH_UP, float(maps.shape[1])), None, config)], None
        if kind == "grids":
            raise UserError(f"{len(maps)} maps of Cell2Fire; expected fire.kind=masks")
        json = path.with_suffix(".json")
        about = json.open(errors="replace").read(1_000_000) if json.is_file() else ""
        horizon = re.search(r'"horizon": *(\d+)', about)
        return _bank(maps.transpose(0, 2, 1)[:, ::-1], horizon and horizon[1], config)
    with _opened(path, kind, config.layer) as dataset:
        affine, crs, tags = tuple(dataset.transform[:6]), dataset.crs, dataset.tags()
        if dataset.transform.is_identity:
            affine = (*_NORTH_UP, float(dataset.height))
        if config.kind == "masks":
            return [_of_states(_read(dataset, MAX_BANK), affine, crs, config)], None
        if tags.get("units") == "steps" and crs is None:
            bands = _read(dataset, MAX_BANK)
            bands = np.where(bands == dataset.nodata, np.inf, bands)
            return _bank(bands, tags.get("horizon"), config)
        check_prj(path, kind, crs)
        return [_band(path, kind, dataset, affine, config)], None


def _band(path: Path, kind: str, dataset: Any, affine: Affine, config: FileFireConfig) -> Raster:
    """Returns the fire of a raster's only band, or of the last time of a NetCDF."""
    band = dataset.count if kind == "nc" else 1
    if dataset.count != band:
        raise UserError(
            f"{dataset.count} bands; expected one, a bank of fires, tagged units=steps, or maps of "
            "states with fire.kind=masks"
        )
    tags = {**dataset.tags(), **dataset.tags(band)}
    titles = dataset.descriptions[band - 1], tags.get("long_name"), tags.get("NETCDF_VARNAME")
    declared = dataset.units[band - 1] or tags.get("units") or ""
    what = f"band {next((title for title in titles if title), band)!r:.60}"
    what += f", the last of {band} times" if band > 1 else ""
    what += f" ({declared})" if declared else ""
    if kind == "asc":  # GDAL reads a word as 0, and wraps rows
        values = _numbers(path, dataset.shape)
        nodata = values == (math.nan if dataset.nodata is None else dataset.nodata)
    else:
        flags = [flag.name for flag in dataset.mask_flag_enums[band - 1]]
        nodata = None if "all_valid" in flags else dataset.read_masks(band) == 0
        values = _read(dataset, MAX_CELLS, band)[0]
    values = values * dataset.scales[band - 1] + dataset.offsets[band - 1]
    unit, since = unit_of(declared, config, what)
    origin = in_utc(parse_dates([since], None, "units")[0]) if since else None
    times = arrival(values, nodata, config)
    return _on_plane(times, affine, dataset.crs, Clock(unit, origin), config, what)


def _numbers(path: Path, shape: tuple[int, ...]) -> np.ndarray:
    """Returns the numbers of ESRI ASCII, whose header GDAL has read."""
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        header = len(list(itertools.takewhile(_HEADER.match, file)))
        file.seek(0)
        most = math.prod(shape) + 1
        try:
            values = np.loadtxt(file, comments=None, ndmin=2, skiprows=header, max_rows=most)
        except ValueError as error:
            raise UserError(
                f"after {header} lines of header: {first_line(error).split(';')[0]}; expected rows "
                f"of {shape[1]} numbers"
            ) from None
    if values.shape != shape:
        raise UserError(f"{values.shape} rows and columns; expected nrows, ncols={shape}")
    return values


def _read(dataset: Any, most: int, band: int | None = None) -> np.ndarray:
    """Reads a band or all, [bands, rows, columns], of bounded size and a type of real numbers."""
    count = 1 if band else dataset.count
    size = max(count * dataset.width * dataset.height, *map(math.prod, dataset.block_shapes))
    kind = np.dtype(dataset.dtypes[0])
    if size > most or kind.kind not in "iuf":
        raise UserError(
            f"{count} x {dataset.height} x {dataset.width} cells of {kind}, in blocks of "
            f"{dataset.block_shapes[0]}; expected at most {most}, of real numbers"
        )
    return dataset.read([band] if band else None)


@contextmanager
def _opened(path: Path, kind: str, layer: str | None) -> Iterator[Any]:
    """Opens a raster by the driver of its name."""
    rasterio = library("rasterio", "a raster")
    name: Any = path.absolute()
    try:
        if kind == "nc":
            with rasterio.open(name, driver="netCDF") as dataset:
                found = [part.rpartition(":")[2] for part in dataset.subdatasets]
            if found and (layer not in found or '"' in str(path)):
                some = "TIGN_G" if "TIGN_G" in found else found[0]
                raise UserError(
                    f"{len(found)} variables: {', '.join(found[:30])}; expected fire.layer, the "
                    f"one of arrival times, such as fire.layer={some}"
                )
            name = f'NETCDF:"{name}":{layer}' if found else name
        with rasterio.open(name, driver=_DRIVERS[kind]) as dataset:
            yield dataset
    except (rasterio.errors.RasterioError, OSError) as error:
        raise UserError(f"{first_line(error)}; expected a whole raster") from None


def _of_states(maps: np.ndarray, affine: Affine, crs: Any, config: FileFireConfig) -> Raster:
    times, what = first_burning(maps, config)
    unit = config.units if config.units not in (None, "steps") else "maps"
    return _on_plane(times, affine, crs, Clock(unit), config, what)


def _on_plane(
    times: np.ndarray, affine: Affine, crs: Any, clock: Clock, config: FileFireConfig, what: str
) -> Raster:
    """Returns times on a plane, north up."""
    if clock.unit in ("days", "day_of_year"):
        times, clock = in_order(times, config), Clock("days", clock.origin)
    a, b, c, d, e, f = (float(value) for value in affine)
    area = abs(a * e - b * d)
    if not math.isfinite(c + f) or not 1e-20 < area < 1e12:
        raise UserError(f"cells of {a:g} x {e:g}; expected a size above 0")
    rows, columns = times.shape
    x, y = (
        [p * u + q * v + r for u in (0, columns) for v in (0, rows)]
        for p, q, r in ((a, b, c), (d, e, f))
    )
    about, change = "no place in the file: square cells, the first row in the north", None
    if crs is not None or affine[:5] != _NORTH_UP:
        bounds = (min(x), min(y), max(x), max(y))
        about, change, _ = choose_plane(crs, config.crs, bounds, math.sqrt(area))
    first = times.min()  # by the cells of the file
    row, column = np.unravel_index(times.argmin(), times.shape)
    around = times[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
    crossing = (around[np.isfinite(around)] - first).max()
    if a < 0 and not (b or d):
        times, a, c = times[:, ::-1], -a, c + columns * a
    if e > 0 and not (b or d):
        times, e, f = times[::-1], -e, f + rows * e
    if change or b or d:
        times, (a, b, c, d, e, f) = warped(times, (a, b, c, d, e, f), change)
        check_spreads(times)
    source = Raster(times, (c, f), (a, -e), clock, doubts=far_apart(np.isfinite(times)))
    if first <= crossing and clock.origin is None and clock.unit not in ("steps", "maps"):
        source.began = 0.0  # the ignition lies between the centres of cells
    places = beginnings(times)
    source.facts = [
        f"{np.isfinite(times).sum()} cells burn from {clock.format(source.first)} to "
        f"{clock.format(source.last)}",
        f"{places} place{'s' * (places != 1)} where it begins",
        what,
        about,
    ]
    return source


def _grids(folder: Path) -> np.ndarray:
    """Reads the maps of Cell2Fire, [time, y, x]."""
    try:
        maps = [np.loadtxt(path, delimiter=",", ndmin=2) for path in forest_grids(folder)]
        return np.stack(maps)
    except ValueError as error:
        raise UserError(f"{first_line(error)}; expected maps of one size") from None


def _numpy(path: Path) -> np.ndarray:
    """Opens an array [fires, X, Y] or [X, Y] of arrival times, or [time, y, x] of states."""
    try:
        # Memory-mapped, so that a wrong header allocates nothing.
        array = np.load(path, mmap_mode="r", allow_pickle=False)
        array = array[None] if array.ndim == 2 else array
        right = array.ndim == 3 and array.dtype.kind in "iufb" and 0 < array.size <= MAX_BANK
    except Exception as error:  # a damaged header raises many types
        raise UserError(f"{first_line(error)}; expected an array in NumPy's format") from None
    if not right:
        raise UserError(
            f"an array of {list(array.shape)}, {array.dtype}; expected [fires, X, Y] of at most "
            f"{MAX_BANK} numbers"
        )
    return array


def _bank(
    fires: np.ndarray, horizon: str | None, config: FileFireConfig
) -> tuple[list[Raster], int | None]:
    """Returns fires in steps, [fires, rows, columns] from north to south, each a whole map."""
    count, rows, columns = fires.shape
    if not SIDES[0] <= min(columns, rows) <= max(columns, rows) <= SIDES[1]:
        raise UserError(f"fires of {columns} x {rows} cells; expected {SIDES[0]} to {SIDES[1]}")
    few = np.unique(fires[:: max(1, count // 8)])
    if len(few) <= 6 and np.isfinite(few).all() and (few % 1 == 0).all():
        states, counts = np.unique(fires, return_counts=True)
        shares = zip(states, counts, strict=True)
        listed = ", ".join(f"{state:g} ({100 * n / fires.size:.0f} %)" for state, n in shares)
        raise UserError(
            f"{count} maps of the states {listed}, and no inf, never; expected arrival times of "
            "fires, or fire.kind=masks for a map of states per time"
        )
    sources = []
    for place, values in enumerate(fires):
        try:
            sources.append(_whole_map(arrival(values, None, config, in_bank=True), "steps"))
        except UserError as error:
            raise UserError(f"fire {place}: {error}") from None
    written = f", written for {horizon} steps" if horizon else ""
    sources[0].facts = [
        f"a bank of {count} fire{'s' * (count > 1)} of {columns} x {rows} cells, in steps{written}"
    ]
    return sources, int(horizon) if horizon else None


def _whole_map(times: np.ndarray, unit: str) -> Raster:
    return Raster(times, (0.0, float(len(times))), (1.0, 1.0), Clock(unit), whole=True)


def _front_points(path: Path, config: FileFireConfig) -> Raster:
    """Reads the paper's text: a point v marks the cell int(v - 29 / 3) and the four beside it."""
    times, count = np.full((_SIDE, _SIDE), np.inf), 0  # [x, y]
    with path.open("rb") as lines:
        for count, line in enumerate(lines, 1):
            parts = line.strip().removesuffix(b",").split(b",") if count > _SKIPPED else [b""]
            try:
                points = np.array([float(p) for p in parts if parts != [b""]]).reshape(-1, 3)
            except ValueError:
                points = np.array([[math.nan]])
            if not (np.abs(points) < 1e9).all():
                raise UserError(f"line {count}: {line[:20]!r}; expected x,y,intensity, of points")
            cells = np.trunc(points[:, :2] - (_SIDE - 1) / 3).astype(np.int64)
            for plus in _PLUS:
                i, j = (cells + plus).T
                inside = (i >= 0) & (j >= 0) & (i < _SIDE) & (j < _SIDE)
                np.minimum.at(times, (i[inside], j[inside]), float(count - 1 - _SKIPPED))
    if count <= _SKIPPED:
        raise UserError(f"{count} lines; expected more than {_SKIPPED}, which are skipped")
    check_spreads(times)
    source = _whole_map(times.T[::-1], config.units or "steps")
    source.facts = [f"the paper's text of {count} lines, a line per time"]
    return source
