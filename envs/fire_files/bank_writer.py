"""Banks of fires as files for use elsewhere: NumPy and GeoTIFF."""

import importlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.publish import new_file, published

SUFFIXES = (".npy", ".tif", ".tiff")
NODATA = -9999.0
"""of the GeoTIFF: never burns, as in FARSITE and FlamMap"""
MOST_BANDS = 4096
"""of a GeoTIFF: what GDAL takes to write and to read them grows with their square"""
MOST_BYTES = 2**30
"""of all fires together"""


def check_bank(path: Path, count: int, grid: Sequence[int]) -> None:
    """That such a bank can be written, before its fires are made.

    Raises:
        ValueError: one line: the suffix is another, a file is there, its folder is not, `rasterio`
            is missing, or it would be too large.
    """
    new_file(path, SUFFIXES)
    size = 4 * count * grid[0] * grid[1]
    if size > MOST_BYTES:
        raise UserError(
            f"{path}: {count} fires of {grid[0]} x {grid[1]} cells are {size} bytes; at most "
            f"{MOST_BYTES} are written"
        )
    if path.suffix == ".npy":
        new_file(path.with_suffix(".json"), [".json"])
    elif count > MOST_BANDS:
        raise UserError(f"{path}: {count} fires; a GeoTIFF gets at most {MOST_BANDS}, .npy more")
    else:
        _rasterio()


def write_bank(
    path: Path, fires: Tensor, *, facts: Mapping[str, Any] | None = None, names: Sequence[str] = ()
) -> None:
    """Writes arrival times where no file is yet, whole or not at all; `fire.path` reads them.

    Args:
        path: ends in .npy, or in .tif or .tiff: one band per fire, north up, tagged units=steps.
            Beside an .npy, a .json of the same name tells the facts.
        fires: float32 [fires, X, Y], steps; inf never burns (-9999 in the GeoTIFF).
        facts: where they are from: text, numbers, lists and mappings.
        names: of the fires, as many as there are.

    Raises:
        ValueError: one line: the suffix is another, the file is there, or it cannot be written.
    """
    check_bank(path, len(fires), fires.shape[1:])
    array = np.ascontiguousarray(fires.cpu().numpy(), dtype="<f4")
    if not (array >= 0).all():
        raise UserError(f"{path}: arrival times are 0 or more, or inf; got NaN or a negative one")
    known = {"units": "steps", **(facts or {})}
    names = names or [f"fire {number}" for number in range(len(array))]
    if path.suffix == ".npy":
        _write_numpy(path, array, known, names)
    else:
        content = _geotiff(array, known, names)
        with published(path) as partial:
            partial.write_bytes(content)


def _write_numpy(
    path: Path, array: NDArray[np.float32], facts: Mapping[str, Any], names: Sequence[str]
) -> None:
    about = {**facts, "axes": ["fire", "x", "y"], "never": "inf", "fires": list(names)}
    beside = path.with_suffix(".json")
    with published(beside) as partial:
        partial.write_text(json.dumps(about, indent=1) + "\n", encoding="utf-8")
    try:
        with published(path) as partial, partial.open("wb") as file:
            header = np.lib.format.header_data_from_array_1_0(array)
            np.lib.format.write_array_header_1_0(file, header)
            file.write(array.data)  # numpy's own would not say that the disk is full
    except BaseException:
        beside.unlink(missing_ok=True)
        raise


def _geotiff(
    array: NDArray[np.float32], facts: Mapping[str, Any], names: Sequence[str]
) -> memoryview:
    """The content of a GeoTIFF: x to the right, y upwards, a cell's (i, j) at its centre."""
    rasterio = _rasterio()
    count, across, up = array.shape
    # In memory first: of a disk that is full, GDAL may only tell its log.
    with rasterio.MemoryFile() as memory:
        with memory.open(
            driver="GTiff",
            count=count,
            width=across,
            height=up,
            dtype="float32",
            nodata=NODATA,
            transform=rasterio.Affine(1, 0, -0.5, 0, -1, up - 0.5),
            compress="deflate",
            interleave="band",
        ) as raster:
            rows = array.transpose(0, 2, 1)[:, ::-1]
            raster.write(np.where(np.isinf(rows), np.float32(NODATA), rows))
            raster.update_tags(**{key: _text(value) for key, value in facts.items()})
            raster.descriptions = tuple(names)
        return memoryview(memory.read())


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def _rasterio() -> Any:
    try:
        return importlib.import_module("rasterio")
    except ImportError:
        raise UserError(
            "a GeoTIFF needs the extra geo: pip install 'emberlink[geo]'; .npy needs nothing more"
        ) from None
