"""Reads rasters of arrival times: ESRI ASCII, GeoTIFF, NetCDF, arrays of states, banks, points."""

import math
import re
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import binary_erosion, map_coordinates, minimum_filter, minimum_filter1d

from emberlink.envs.fire_files.config import FileFireConfig
from emberlink.envs.fire_files.files import GRIDS, damage, members
from emberlink.envs.fire_files.plane import DEGREES, Bounds, Plane, Window, choose_plane
from emberlink.envs.fire_files.report import Clock, Report, ask
from emberlink.envs.fire_files.times import decided_unit, in_order, in_utc, names_unit, parse_dates
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import as_argument

_MAX_CELLS = 50_000_000
MAX_BANK = 300_000_000
"""Maximum number of cells of all fires of a bank: 1.2 GB."""
_DRIVERS = {"tif": "GTiff", "nc": "netCDF", "asc": "AAIGrid"}
_SIDE = 30  # cells along a side of the paper's map
_SKIPPED = 6000  # lines of the paper's text before step 0
_CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]])
_NEVER = (-9999.0, -1.0)  # NODATA of FARSITE and FlamMap, and of ELMFIRE
_Times = tuple[np.ndarray, Clock, str]
_VOID = 1e30  # a number beyond it is NODATA although not declared, such as -3.4e38


@dataclass
class Raster:
    """A fire of arrival times in cells, [rows, columns], inf for never."""

    clock: Clock
    first: float
    """time of the first arrival"""
    last: float
    whole: bool
    """True for a map of the whole grid, which is neither cropped nor burnt out"""
    times: np.ndarray
    matrix: np.ndarray
    """affine, [3, 3]: x and y of a fractional column and row"""
    plane: Plane

    def bounds(self, until: float | None) -> Bounds:
        """Returns the bounds of the raster, or of the area burnt by a time, up to the front."""
        if until is None:
            at = np.array([(0, 0), (0, 1), (1, 0), (1, 1)]) * self.times.shape
            x, y = self._places(*at.T)
        else:
            burnt = self.times <= until
            if burnt.sum() < 2:
                ends = map(self.clock.format, (until, self.first, self.last))
                raise UserError("until {} no fire spreads; it burns from {} to {}".format(*ends))
            inner: Any = binary_erosion(burnt)
            at = np.stack(np.nonzero(burnt & ~inner))
            # Along each axis, the front has passed the centre by less than a cell.
            before = [minimum_filter1d(self.times, 3, axis)[*at] for axis in (0, 1)]
            left, passed = until - self.times[*at], self.times[*at] - before
            reach = np.where(left < passed, left / np.where(passed > 0, passed, 1), 0.5)
            x, y = self._places(*np.concatenate([at + 0.5 - reach, at + 0.5 + reach], 1))
        return float(x.min()), float(y.min()), float(x.max()), float(y.max())

    def on(self, window: Window, until: float, report: Report) -> np.ndarray:
        """Interpolates bilinearly between burnt cells; returns the earliest, float64 [X, Y].

        A map of the whole grid, and a raster with the grid's cells, are not interpolated.
        """
        at = self._cells(window)
        if np.abs(at - np.rint(at)).max() > 1e-3:
            at = self._cells(window.samples())
        burns = np.isfinite(self.times)
        times = map_coordinates(self.times, at, order=0, mode="grid-constant", cval=np.inf)
        if not self.whole:
            weights, total = (
                map_coordinates(values, at, order=1, mode="nearest")
                for values in (burns.astype(np.float64), np.where(burns, self.times, 0.0))
            )
            between = np.maximum(total / np.where(weights > 0, weights, 1), self.first)
            times = np.where(np.isinf(times) | (weights == 0), np.inf, between)
        earliest = window.earliest(times)
        # Samples that are farther apart than the cells miss some of these.
        missed = np.abs(at[:, 1, 1] - at[:, 0, 0]).max() > 1 + 1e-6
        burns &= missed | (self.times == minimum_filter(self.times, 3))
        i, j, there = window.cells(*self._places(*(np.array(np.nonzero(burns)) + 0.5)))
        np.minimum.at(earliest, (i[there], j[there]), self.times[burns][there])
        return earliest

    def _places(self, rows: Any, columns: Any) -> tuple[np.ndarray, np.ndarray]:
        """Returns x and y on the plane of fractional rows and columns."""
        (a, b, c), (d, e, f), _ = self.matrix
        x, y = a * columns + b * rows + c, d * columns + e * rows + f
        return self.plane.project(x, y)

    def _cells(self, window: Window) -> np.ndarray:
        """Returns the rows and columns, 0 at the first centre, of a window's centres, [2, X, Y]."""
        x, y = self.plane.project(*window.centres(), back=True)
        (a, b, c), (d, e, f), _ = np.linalg.inv(self.matrix)
        at = np.stack([d * x + e * y + f, a * x + b * y + c]) - 0.5
        return np.nan_to_num(at, nan=-9, posinf=-9, neginf=-9)


def as_fire(times: np.ndarray, clock: Clock, plane: Plane | None = None) -> Raster:
    """Returns a fire of square cells, the first row in the north; without plane, a whole map."""
    burning = times[np.isfinite(times)]
    if len(burning) < 2:
        raise ask(f"cells that burn: {len(burning)}", "arrival times of a fire that spreads")
    north_up = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, len(times)], [0.0, 0.0, 1.0]])
    ends, times = (float(burning.min()), float(burning.max())), times.astype(np.float64)
    return Raster(clock, *ends, plane is None, times, north_up, plane or Plane(""))


def read_raster(
    path: Path, kind: str, config: FileFireConfig, horizon: int, report: Report
) -> list[Raster]:
    """Reads the fire of a raster, or the fires of a bank."""
    if kind == "points":
        return [_front_points(path, config, report)]
    if kind in ("npy", "grids"):
        maps, affine, crs, in_degrees = _array(path, kind), np.eye(3), None, False
        if config.kind != "masks":
            return _bank(maps, config, horizon, report)
        times, clock, what = _of_states(maps, config)
    else:
        with damage("a whole raster"), _opened(path, kind, config.layer) as dataset:
            affine, crs = np.reshape(dataset.transform, (3, 3)), dataset.crs
            in_degrees = "degrees_north" in dataset.tags().values()  # an axis of NetCDF
            read = _maps_of_states if config.kind == "masks" else _band
            times, clock, what = read(dataset, config, report)
    nowhere = Plane("no place in the file: square cells, the first row in the north")
    fire = as_fire(times, clock, nowhere)
    if crs is not None or not np.allclose(affine, np.eye(3)):
        fire.matrix = affine
        bounds = fire.bounds(fire.last)
        if crs is None and in_degrees and max(map(abs, bounds)) <= 360:
            crs = DEGREES
        fire.plane = choose_plane(crs, config.crs, bounds)
    begin, end = clock.format(fire.first), clock.format(fire.last)
    burn = f"{np.isfinite(times).sum()} cells burn from {begin} to {end}"
    report.facts += [burn, what, fire.plane.about]
    return [fire]


def _opened(path: Path, kind: str, layer: str | None) -> Any:
    """Opens a raster by the driver of its name."""
    import rasterio

    name: Any = path.absolute()
    if kind == "nc":
        with rasterio.open(name, driver="netCDF") as dataset:
            found = [part.rpartition(":")[2] for part in dataset.subdatasets]
        if found and layer not in found:
            some = "TIGN_G" if "TIGN_G" in found else found[0]
            seen = f"{len(found)} variables: {', '.join(found[:30])}"
            raise ask(seen, f"the one of arrival times, such as fire.layer={some}")
        name = f'NETCDF:"{name}":{layer}' if found else name
    more: Any = {"DATATYPE": "Float64"} if kind == "asc" else {}
    return rasterio.open(name, driver=_DRIVERS[kind], **more)


def _read(dataset: Any, most: int, band: int | None = None) -> np.ndarray:
    """Reads a band or all, [bands, rows, columns], of bounded size and a type of real numbers."""
    count = 1 if band else dataset.count
    size = max(count * dataset.height * dataset.width, *map(math.prod, dataset.block_shapes))
    if size > most or np.dtype(dataset.dtypes[0]).kind not in "iuf":
        seen = f"{count} x {dataset.height} x {dataset.width} cells of {dataset.dtypes[0]}"
        raise ask(f"{seen}, in blocks of {dataset.block_shapes[0]}", f"{most} real numbers at most")
    return dataset.read([band] if band else None)


def _band(dataset: Any, config: FileFireConfig, report: Report) -> _Times:
    """Returns the times of the band `fire.layer` or of a variable's last band, and their clock."""
    variable, band = dataset.tags(1).get("NETCDF_VARNAME"), dataset.count
    titles = [str(title or number) for number, title in enumerate(dataset.descriptions, 1)]
    names = [variable] if variable else titles
    if (layer := config.layer) and layer in names:
        band = band if variable else names.index(layer) + 1
    elif layer or len(names) > 1:
        seen = f"the bands {', '.join(names[:30])}"
        key = f"the one of arrival times, such as {as_argument('fire.layer', names[0])}"
        raise ask(seen, key, "maps of states with fire.kind=masks")
    tags = dataset.tags() | dataset.tags(band)  # with a #, it is of another variable
    tags = {name.lower(): text for name, text in tags.items() if "#" not in name}
    told = (text for name, text in tags.items() if names_unit(name))
    declared = (dataset.units[band - 1] or next(told, "")).strip(" []")
    what = f"band {tags.get('long_name', variable or titles[band - 1])!r:.60}"
    what += f", the last of {band} times" if variable and band > 1 else ""
    what += f" ({declared})" if declared else ""
    values, nodata = _read(dataset, _MAX_CELLS, band)[0], dataset.read_masks(band) == 0
    if config.units is None and not declared.strip("-1") and _are_states(values[~nodata]):
        states = "fire.kind=masks if they are states", "fire.units=hours or such if they are times"
        raise ask(f"{what} has no other values than states have", *states)
    values = values * dataset.scales[band - 1] + dataset.offsets[band - 1]
    unit, origin = _unit(declared, config, what, report)
    return *in_order(_arrival(values, config, nodata), unit, config, origin), what


def _unit(
    declared: str, config: FileFireConfig, what: str, report: Report
) -> tuple[str, datetime | None]:
    """Returns the unit of times, and the date of 0 if it is declared, as in `days since` it."""
    unit, since = decided_unit(declared, config, what, report), declared.partition(" since ")[2]
    if not re.search(r"\d", since):  # the time of ignition, for example, has no date
        return unit, None
    return unit, in_utc(parse_dates([since.strip()], config.time_format, "units")[0])


def _are_states(values: np.ndarray) -> bool:
    """Returns whether values are whole numbers of maps of states, and maybe NODATA."""
    return bool(np.isin(values, (*range(6), *_NEVER)).all())


def _maps_of_states(dataset: Any, config: FileFireConfig, report: Report) -> _Times:
    """Returns the times of maps of states in bands, at the times of their axis in NetCDF."""
    maps, nodata, at, clock = _read(dataset, MAX_BANK), dataset.read_masks() == 0, None, None
    tags = [dataset.tags(band) for band in dataset.indexes]
    for axis in [name for name in tags[0] if name.startswith("NETCDF_DIM_")]:
        places = np.array([float(tag[axis]) for tag in tags])
        name = axis.removeprefix("NETCDF_DIM_")
        declared = dataset.tags().get(f"{name}#units", "")
        even = len(np.unique(np.diff(places).round(6))) < 2 and not declared
        if len(np.unique(places)) == len(maps) > 1 and not even:
            clock = _unit(declared, config, f"the axis {name}", report)
            order = np.argsort(places)
            maps, nodata, at = maps[order], nodata[order], places[order]
    return _of_states(maps, config, nodata, at, clock)


def _of_states(
    maps: np.ndarray,
    config: FileFireConfig,
    nodata: np.ndarray | bool = False,
    at: np.ndarray | None = None,
    clock: tuple[str, datetime | None] | None = None,
) -> _Times:
    """Returns the time, or number, of the first map in which each cell is not unburnt."""
    nodata = nodata | np.isnan(maps)
    states = np.unique(maps[~nodata])
    listed = ", ".join(f"{state:g}" for state in states[:12])
    burns = ~nodata & ~np.isin(maps, (0,) if config.never is None else config.never)
    odd, share = not np.isin(states, (0, 1, 2)).all(), burns[0].mean()
    if config.never is None and (odd or share > 0.5):
        others = ",".join(f"{state:g}" for state in states if state not in (1, 2))
        some = f"[{others}]' if 1 and 2 are fire" if odd else "[0,1]' if 1 is a tree"
        seen = f"states {listed}, not 0 in {share:.0%} of the first map"
        raise ask(seen, f"fire.unburned, those that are no fire, such as 'fire.unburned={some}")
    first = burns.argmax(0)
    times = np.where(burns.any(0), first if at is None else at[first], np.inf)
    unit = config.units if config.units not in (None, "steps") else "maps"
    size = " x ".join(map(str, maps.shape[:0:-1]))
    what = f"{len(maps)} maps of {size} cells, states {listed}, rows from north to south"
    what += ", at the times of their axis" if clock else ""
    unit, origin = clock or (unit, None)
    return *in_order(times, unit, config, origin), what


def _array(path: Path, kind: str) -> np.ndarray:
    """Opens an array [fires, X, Y] or [X, Y] of arrival times, or [time, y, x] of states."""
    with damage("an array of NumPy, or maps of one size"):
        if kind == "grids":
            return np.stack([np.loadtxt(p, delimiter=",", ndmin=2) for p in members(path)])
        # Memory-mapped, so that a wrong header allocates nothing.
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    array = array[None] if array.ndim == 2 else array
    if array.ndim != 3 or array.dtype.kind not in "iufb" or not 0 < array.size <= MAX_BANK:
        seen = f"an array of {list(array.shape)}, {array.dtype}"
        raise ask(seen, f"[fires, X, Y] of at most {MAX_BANK} numbers")
    return array


def _bank(fires: np.ndarray, config: FileFireConfig, horizon: int, report: Report) -> list[Raster]:
    """Returns fires in steps, [fires, X, Y], each a whole map."""
    count, columns, rows = fires.shape
    if config.never is None and _are_states(fires[~np.isnan(fires)]):
        states, cells = np.unique(fires, return_counts=True)
        shares = zip(states, cells / fires.size, strict=True)
        seen = ", ".join(f"{state:g} ({share:.0%})" for state, share in shares)
        seen = f"{count} maps of the states {seen}"
        raise ask(seen, "fire.kind=masks", "fire.unburned=none if they are steps")
    if config.units not in (None, "steps") and config.test is None:  # no other file has units
        raise ask(f"fire.units={config.units}: a bank is in steps", "none")
    report.facts.append(f"a bank of {count} fires of {columns} x {rows} cells, in steps")
    times = _arrival(fires.reshape(-1, rows), config, bank=True).reshape(fires.shape)
    read = [as_fire(fire.T[::-1], Clock("steps")) for fire in times]
    last = max(fire.last for fire in read)
    if config.start is config.end is None and last > horizon:
        report.doubts.append(f"fires burn until step {last:g}: fire.end={last:g} stretches them")
    return read


def _front_points(path: Path, config: FileFireConfig, report: Report) -> Raster:
    """Reads the paper's text: a point v marks the cell int(v - 29 / 3) and the four beside it."""
    times, count = np.full((_SIDE + 4, _SIDE + 4), np.inf), 0  # [x, y], two cells on each side
    with path.open("rb") as lines:
        for count, line in enumerate(lines, 1):
            if count <= _SKIPPED or not line.strip():
                continue
            with damage(f"x,y,intensity, of points in line {count}"):
                values = [float(part) for part in line.strip().removesuffix(b",").split(b",")]
                points = np.reshape(values, (-1, 3))[:, :2] - (_SIDE - 1) / 3
            x, y = np.trunc(points).clip(-2, _SIDE + 1).astype(int).T + 2
            np.minimum.at(times, (x, y), float(count - 1 - _SKIPPED))
    if np.isinf(times).all():
        seen = f"a text of {count} lines, without points after line {_SKIPPED} as the paper's has"
        raise ask(seen, f"the folder of Cell2Fire's {GRIDS}*.csv", "a raster as ESRI ASCII or TIFF")
    report.facts.append(f"the paper's text of {count} lines, a line per time")
    times = minimum_filter(times, footprint=_CROSS)[2:-2, 2:-2]
    return as_fire(times.T[::-1], Clock(config.units or "steps"))


def _arrival(
    values: np.ndarray,
    config: FileFireConfig,
    nodata: np.ndarray | bool = False,
    *,
    bank: bool = False,
) -> np.ndarray:
    """Returns arrival times, inf for never; asks about negative ones and plateaus.

    In a bank, less than half of the cells may burn at step 0, where an episode begins.
    """
    times = np.array(values, np.result_type(values, np.float32))
    never = np.array([*_NEVER, *(config.never or ())], times.dtype)
    times[~(np.abs(times) <= _VOID) | np.isin(times, never) | nodata] = np.inf
    told, counts = np.unique(times[np.isfinite(times)], return_counts=True)
    odd = told < 0
    if not isinstance(config.unburned, tuple | str):  # a list has all of them
        begins = (told == 0) & bank & (2 * counts < times.size)
        if config.unburned is None and (~odd).sum() > 1:
            odd |= ~begins & (counts > counts[~odd].sum() / 2)
        while (more := _apart(times, told, np.where(odd | begins, 0, counts))).any():
            odd |= more
    if odd.any():
        asked = [f"{value:.9g}" for value in told[odd][:6]]
        shares = zip(asked, counts[odd] / counts.sum(), strict=False)
        listed = " and ".join(f"{value} ({share:.0%} of the cells)" for value, share in shares)
        others = f"{told[~odd].min():g} to {told[~odd].max():g}" if not odd.all() else "none"
        seen = f"{listed} may stand for cells that do not burn (others: {others})"
        given = ",".join(f"{value:.9g}" for value in config.never or ())
        some = ",".join([*filter(None, [given]), *asked])
        key = f"'fire.unburned=[{some}]'" if "," in some else f"fire.unburned={some}"
        other = f"'fire.unburned=[{given}]'" if given else "fire.unburned=none"
        raise ask(seen, key, *[f"{other} if they burn then"] * (not (told < 0).any()))
    return times


def _apart(times: np.ndarray, told: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Returns which values may stand for cells that do not burn, of those with a count above 0.

    They are the first or last value, and far from the rest or frequent along the edge of the
    raster, where a fire has cells of many times.
    """
    times = np.where(np.isin(times, told[counts == 0]), np.inf, times)
    odd, held = np.zeros(len(told), np.bool_), np.flatnonzero(counts)
    if len(held) > 2:
        few = len(held) == 3  # of three values only, 0, 60 and 180 are times
        inner: Any = binary_erosion(np.isfinite(times))
        edge = times[np.isfinite(times) & ~inner]
        for at, (first, last) in ((held[0], held[[1, -1]]), (held[-1], held[[-2, 0]])):
            far = abs(told[at] - told[first]) > abs(told[last] - told[first]) * (10 if few else 1)
            rest = np.delete(counts, at).max()
            often = not few and counts[at] > max(0.1 * counts.sum(), 3 * rest)
            odd[at] |= far or (often and (edge == told[at]).mean() > 0.5)
    return odd
