"""Banks of fires: NumPy and GeoTIFF files with a map of the whole grid for each fire."""

import importlib
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from emberlink.envs.config import SIDES
from emberlink.envs.fire_files.projection import first_line
from emberlink.envs.fire_files.raster_source import RasterSource, check_spreads
from emberlink.envs.fire_files.rasters import clean, open_raster
from emberlink.envs.fire_files.times import Clock
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.publish import new_file, published

SUFFIXES = (".npy", ".tif", ".tiff")
MAX_CELLS = 300_000_000
"""Of all fires of a bank that is read: 1.2 GB."""
MAX_BANDS = 4096
"""Of a GeoTIFF that is written: the time that GDAL takes grows with their square."""
MAX_BYTES = 2**30
"""Of a bank that is written."""
_MAX_FACTS = 50_000_000  # bytes of the .json beside an .npy
_NODATA = -9999.0  # never burns, as in FARSITE and FlamMap


def read_npy(path: Path) -> Iterator[RasterSource]:
    """Reads the fires of a NumPy file, [fires, X, Y] or [X, Y], steps.

    Raises:
        UserError: the array or one of its fires is not what is expected.
    """
    try:
        # Mapped, so that a header that promises more than there is costs no memory.
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except Exception as error:  # of many types, if the header is damaged
        raise UserError(f"{first_line(error)}; expected an array in NumPy's format") from None
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "iuf":
        kind = getattr(array, "dtype", type(array).__name__)
        raise UserError(f"values of type {kind}; expected numbers")
    fires = array[None] if array.ndim == 2 else array
    if fires.ndim != 3 or len(fires) == 0:
        raise UserError(f"an array of shape {list(array.shape)}; expected [fires, X, Y]")
    _check_size(fires.shape)
    for index, fire in enumerate(fires):
        yield _fire(index, fire.T[::-1])


def is_bank(path: Path) -> bool:
    """Tells whether a GeoTIFF is a bank: tagged units=steps, and without a projection."""
    with open_raster(path) as dataset:
        return dataset.tags().get("units") == "steps" and dataset.crs is None


def bank_horizon(path: Path) -> int | None:
    """Returns the horizon for which a bank was written, steps; None if it does not say so."""
    try:
        if path.suffix.lower() == ".npy":
            beside = path.with_suffix(".json")
            known = beside.is_file() and beside.stat().st_size <= _MAX_FACTS
            horizon = json.loads(beside.read_text(encoding="utf-8"))["horizon"] if known else None
        else:
            with open_raster(path) as dataset:
                horizon = dataset.tags().get("horizon")
        return None if horizon is None else int(horizon)
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None  # of another program, or damaged


def read_bands(path: Path) -> Iterator[RasterSource]:
    """Reads the fires of a GeoTIFF with a band for each, north up, steps.

    Raises:
        UserError: the file or one of its fires is not what is expected.
    """
    with open_raster(path) as dataset:
        _check_size((dataset.count, dataset.width, dataset.height))
        if np.dtype(dataset.dtypes[0]).kind not in "iuf":
            raise UserError(f"values of type {dataset.dtypes[0]}; expected numbers")
        nodata, bands = dataset.nodata, dataset.read()
    for index, band in enumerate(bands):
        yield _fire(index, band if nodata is None else np.where(band == nodata, np.inf, band))


def _check_size(shape: Sequence[int]) -> None:
    fires, width, height = shape
    if not all(SIDES[0] <= side <= SIDES[1] for side in (width, height)):
        raise UserError(
            f"fires of {width} x {height} cells; expected {SIDES[0]} to {SIDES[1]} a side"
        )
    if fires * width * height > MAX_CELLS:
        raise UserError(f"{fires} fires of {width} x {height}; at most {MAX_CELLS} cells are read")


def _fire(index: int, times: np.ndarray) -> RasterSource:
    """Returns a map of the whole grid, whose rows run from north to south."""
    try:
        times = clean(times)
        check_spreads(times, may_stand=True)
    except UserError as error:
        raise UserError(f"fire {index}: {error}") from None
    return RasterSource(times, (0.0, float(len(times))), (1.0, 1.0), Clock("steps"), whole=True)


def check_bank(path: Path, count: int, grid: Sequence[int]) -> None:
    """Checks that such a bank can be written, before its fires are made.

    Raises:
        UserError: the suffix is another, a file is there, its folder is not, `rasterio` is
            missing, or the bank would be too large.
    """
    new_file(path, SUFFIXES)
    size = 4 * count * grid[0] * grid[1]
    if size > MAX_BYTES:
        raise UserError(
            f"{path}: {count} fires of {grid[0]} x {grid[1]} cells are {size} bytes; at most "
            f"{MAX_BYTES} are written"
        )
    if path.suffix == ".npy":
        new_file(path.with_suffix(".json"), [".json"])
    elif count > MAX_BANDS:
        raise UserError(f"{path}: {count} fires; a GeoTIFF gets at most {MAX_BANDS}, .npy more")
    else:
        _rasterio()


def write_bank(
    path: Path, fires: Tensor, *, facts: Mapping[str, Any] | None = None, names: Sequence[str] = ()
) -> None:
    """Writes arrival times to a new file, whole or not at all; `fire.path` reads it.

    Args:
        path: ends in .npy, or in .tif or .tiff: one band per fire, north up, tagged units=steps.
            Beside an .npy, a .json of the same name holds the facts.
        fires: float32 [fires, X, Y], steps; inf never burns (-9999 in the GeoTIFF).
        facts: where they are from: text, numbers, lists and mappings.
        names: of the fires, as many as there are.

    Raises:
        UserError: as `check_bank`, or the file cannot be written.
    """
    check_bank(path, len(fires), fires.shape[1:])
    array = np.ascontiguousarray(fires.cpu().numpy(), dtype="<f4")
    assert (array >= 0).all(), "arrival times are 0 or more, or inf"
    facts = {"units": "steps", **(facts or {})}
    names = names or [f"fire {number}" for number in range(len(array))]
    if path.suffix == ".npy":
        _write_numpy(path, array, facts, names)
    else:
        content = _geotiff(array, facts, names)
        with published(path) as partial:
            partial.write_bytes(content)


def _write_numpy(
    path: Path, array: NDArray[np.float32], facts: Mapping[str, Any], names: Sequence[str]
) -> None:
    about = {**facts, "axes": ["fire", "x", "y"], "never": "inf", "fires": list(names)}
    json_path = path.with_suffix(".json")
    with published(json_path) as partial:
        partial.write_text(json.dumps(about, indent=1) + "\n", encoding="utf-8")
    try:
        with published(path) as partial, partial.open("wb") as file:
            header = np.lib.format.header_data_from_array_1_0(array)
            np.lib.format.write_array_header_1_0(file, header)
            file.write(array.data)  # NumPy's own does not report a full disk
    except BaseException:
        json_path.unlink(missing_ok=True)
        raise


def _geotiff(
    array: NDArray[np.float32], facts: Mapping[str, Any], names: Sequence[str]
) -> memoryview:
    """Returns the content of a GeoTIFF, x to the right and y upwards."""
    rasterio = _rasterio()
    count, width, height = array.shape
    # In memory first: GDAL reports a full disk only in its log.
    with rasterio.MemoryFile() as memory:
        with memory.open(
            driver="GTiff",
            count=count,
            width=width,
            height=height,
            dtype="float32",
            nodata=_NODATA,
            transform=rasterio.Affine(1, 0, -0.5, 0, -1, height - 0.5),
            compress="deflate",
            interleave="band",
        ) as raster:
            rows = array.transpose(0, 2, 1)[:, ::-1]
            raster.write(np.where(np.isinf(rows), np.float32(_NODATA), rows))
            tags = {k: v if isinstance(v, str) else json.dumps(v) for k, v in facts.items()}
            raster.update_tags(**tags)
            raster.descriptions = tuple(names)
        return memoryview(memory.read())


def _rasterio() -> Any:
    try:
        return importlib.import_module("rasterio")
    except ImportError:
        raise UserError(
            "a GeoTIFF needs the extra geo: pip install '.[geo]' in Emberlink's folder; .npy needs "
            "nothing more"
        ) from None
