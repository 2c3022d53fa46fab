"""Writes fires to a file: a bank, with a map of the whole grid for each fire."""

import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from emberlink.envs.fire_files.files import library
from emberlink.envs.utils.atomic_io import created, new_file
from emberlink.envs.utils.errors import UserError
from emberlink.trainers.runs.compact_json import finite

SUFFIXES = (".npy", ".tif", ".tiff")
_MAX_BANDS = 4096  # the time that GDAL takes grows with the square of their number
_MAX_BYTES = 2**30
_NODATA = -9999.0  # never burns, as in FARSITE and FlamMap


def check_bank(path: Path, count: int, grid: Sequence[int]) -> None:
    """Checks that a bank can be written, before its fires are made."""
    new_file(path, SUFFIXES)
    size = 4 * count * grid[0] * grid[1]
    if size > _MAX_BYTES:
        raise UserError(f"{path}: {count} fires are {size} bytes; at most {_MAX_BYTES} are written")
    if path.suffix == ".npy":
        new_file(path.with_suffix(".json"), [".json"])
    elif count > _MAX_BANDS:
        raise UserError(f"{path}: {count} fires; a GeoTIFF gets at most {_MAX_BANDS}, .npy more")
    else:
        library("rasterio", f"{path}: a GeoTIFF, unlike .npy,")


def write_bank(
    path: Path, fires: Tensor, *, facts: Mapping[str, Any] | None = None, names: Sequence[str] = ()
) -> None:
    """Writes fires, float32 [fires, X, Y], steps, to a new file, which `fire.path` reads.

    Beside an .npy, a .json of the same name holds the facts. A partial file is removed.
    """
    check_bank(path, len(fires), fires.shape[1:])
    array = np.ascontiguousarray(fires.cpu().numpy(), dtype="<f4")
    about = finite({"units": "steps", **(facts or {})})
    names = names or [f"fire {number}" for number in range(len(array))]
    # In memory first: neither GDAL nor NumPy reports a full disk.
    if path.suffix != ".npy":
        content = _geotiff(array, about, names)
        with created(path) as partial:
            partial.write_bytes(content)
        return
    memory = io.BytesIO()
    np.save(memory, array)
    about |= {"axes": ["fire", "x", "y"], "never": "inf", "fires": list(names)}
    with created(path.with_suffix(".json")) as card, created(path) as partial:
        card.write_text(json.dumps(about, indent=1) + "\n", encoding="utf-8")
        partial.write_bytes(memory.getbuffer())


def _geotiff(array: np.ndarray, facts: Mapping[str, Any], names: Sequence[str]) -> memoryview:
    """Returns the content of a GeoTIFF, x to the right and y upwards."""
    rasterio = library("rasterio")
    count, width, height = array.shape
    rows = array.transpose(0, 2, 1)[:, ::-1]
    about: dict[str, Any] = {"driver": "GTiff", "count": count, "width": width, "height": height}
    about |= {"dtype": "float32", "nodata": _NODATA, "compress": "deflate", "interleave": "band"}
    about["transform"] = rasterio.Affine(1, 0, -0.5, 0, -1, height - 0.5)
    with rasterio.MemoryFile() as memory:
        with memory.open(**about) as raster:
            raster.write(np.where(np.isinf(rows), np.float32(_NODATA), rows))
            tags = {k: v if isinstance(v, str) else json.dumps(v) for k, v in facts.items()}
            raster.update_tags(**tags)
            raster.descriptions = tuple(names)
        return memoryview(memory.read())
