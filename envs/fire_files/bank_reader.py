"""Banks of fires: NumPy and GeoTIFF files with a map of the whole box for each fire."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from emberlink.envs.config import SIDES
from emberlink.envs.utils.errors import UserError

from .arrival_raster import Clock, RasterSource
from .gdal_open import opened
from .geotiff import check_spreads, clean
from .projection import first_line

MOST_CELLS = 300_000_000
"""of all fires together: 1.2 GB"""


def read_npy(path: Path) -> Iterator[RasterSource]:
    """The fires of a NumPy file, [fires, X, Y] or [X, Y], steps.

    Raises:
        ValueError: one line that names what is wrong, and the fire.
    """
    try:
        # Mapped, so that a header that promises more than there is costs no memory.
        found = np.load(path, mmap_mode="r", allow_pickle=False)
    except Exception as error:  # numpy raises what it likes on a damaged header
        raise UserError(f"{first_line(error)}; expected an array in NumPy's format") from None
    if not isinstance(found, np.ndarray) or found.dtype.kind not in "iuf":
        kind = getattr(found, "dtype", type(found).__name__)
        raise UserError(f"values of type {kind}; expected numbers")
    fires = found[None] if found.ndim == 2 else found
    if fires.ndim != 3 or len(fires) == 0:
        raise UserError(f"an array of shape {list(found.shape)}; expected [fires, X, Y]")
    _check_size(fires.shape)
    for index, fire in enumerate(fires):
        # Rows of a raster run north to south.
        yield _fire(index, fire.T[::-1])


def is_bank(path: Path) -> bool:
    """Whether a GeoTIFF is a bank: tagged units=steps, and of no place on the Earth."""
    with opened(path) as dataset:
        return dataset.tags().get("units") == "steps" and dataset.crs is None


def read_bands(path: Path) -> Iterator[RasterSource]:
    """The fires of a GeoTIFF with a band for each, north up, steps.

    Raises:
        ValueError: one line that names what is wrong, and the fire.
    """
    with opened(path) as dataset:
        _check_size((dataset.count, dataset.width, dataset.height))
        if np.dtype(dataset.dtypes[0]).kind not in "iuf":
            raise UserError(f"values of type {dataset.dtypes[0]}; expected numbers")
        nodata, bands = dataset.nodata, dataset.read()
    for index, band in enumerate(bands):
        yield _fire(index, band if nodata is None else np.where(band == nodata, np.inf, band))


def _check_size(shape: tuple[int, ...]) -> None:
    fires, width, height = shape
    if not all(SIDES[0] <= side <= SIDES[1] for side in (width, height)):
        raise UserError(
            f"fires of {width} x {height} cells; expected {SIDES[0]} to {SIDES[1]} a side"
        )
    if fires * width * height > MOST_CELLS:
        raise UserError(f"{fires} fires of {width} x {height}; at most {MOST_CELLS} cells are read")


def _fire(index: int, times: np.ndarray) -> RasterSource:
    """One map of the whole box; rows run north to south."""
    try:
        times = clean(times)
        check_spreads(times, may_stand=True)
    except ValueError as error:
        raise UserError(f"fire {index}: {error}") from None
    affine = (1.0, 0.0, 0.0, 0.0, -1.0, float(len(times)))
    return RasterSource(times, affine, Clock("steps"), whole=True)
