"""Reads the fires of a file onto a grid, in three sets, and keeps a run's copy of them."""

import dataclasses
import hashlib
import io
import json
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from emberlink.envs.config import check_grid
from emberlink.envs.fire_files import formats
from emberlink.envs.fire_files.config import COPY_FILE, FileFireConfig
from emberlink.envs.fire_files.episode_crop import on_grid
from emberlink.envs.fire_files.grid_maps import (
    MAX_CELLS,
    map_of_grid,
    read_front_points,
    read_geotiff_bank,
    read_numpy_bank,
)
from emberlink.envs.fire_files.perimeters import read_perimeters
from emberlink.envs.fire_files.projection import quiet
from emberlink.envs.fire_files.raster_source import Source
from emberlink.envs.fire_files.rasters import read_ascii, read_geotiff
from emberlink.envs.utils.atomic_io import read_sealed, write_sealed
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import printable

READER_VERSION = 6  # increase it if the same file gives another grid
_MAX_COPY = 12 * MAX_CELLS + 1_000_000  # bytes when unpacked: float32 of the cells of all sets
_EVERY, _VALIDATION, _TEST = 5, 3, 4  # remainders of the numbers of validation and test fires


def read_fires(config: FileFireConfig, grid: tuple[int, int], horizon: int) -> Tensor:
    """Returns the fires of `config.path` on a grid.

    Args:
        config: the scenario.
        grid: (X, Y), each 8 to 256 cells.
        horizon: steps of an episode.

    Returns:
        float32 [fires, X, Y], steps: 0 burns from the start, inf never burns.

    Raises:
        UserError: one line that names the file and the mistake in it.
    """
    return read_with_summary(config, grid, horizon)[0]


def read_with_summary(
    config: FileFireConfig, grid: tuple[int, int], horizon: int
) -> tuple[Tensor, str]:
    """Returns the fires as `read_fires` does, and a line that describes the file.

    Warns if a raster seems to hold something other than arrival times, such as elevation.
    """
    check_grid(grid)
    path = Path(config.path).expanduser()
    name = printable(str(path))
    try:
        with quiet():
            fires, summary, doubts = _read(path, config, grid, horizon)
    except UserError as error:
        raise UserError(f"{name}: {printable(str(error))}") from None
    except OSError as error:
        raise UserError(f"{name}: cannot be read: {error.strerror or error}") from None
    except MemoryError:
        raise UserError(f"{name}: not enough memory to read it") from None
    summary = printable(summary)
    if doubts:
        signs = printable("; ".join(doubts))
        warnings.warn(f"{name}: {summary}; {signs}: are these arrival times?", stacklevel=3)
    return torch.from_numpy(np.stack(fires)), summary


def _read(
    path: Path, config: FileFireConfig, grid: tuple[int, int], horizon: int
) -> tuple[list[np.ndarray], str, Sequence[str]]:
    """Returns the fires in a file, [X, Y] each, a summary, and signs that they are no fires."""
    kind = None if path.is_dir() else formats.find_format(path)
    if config.incident is not None and kind is not None and kind not in formats.PERIMETERS:
        raise UserError(
            f"fire.incident={config.incident} chooses among perimeters; expected none for "
            f"{kind.name}"
        )
    bank = None
    if kind is formats.NUMPY:
        bank = read_numpy_bank(path)
    elif kind is formats.GEOTIFF:
        bank = read_geotiff_bank(path)
    if bank is None:
        source = _read_one(path, kind, config)
        fire = on_grid(source, config, grid, horizon)
        return [fire], source.summary, source.doubts
    if config.units not in (None, "steps") and config.test is None:  # no other file has units
        raise UserError(f"fire.units={config.units}: a bank is in steps; expected none")
    if config.minutes_per_step is not None:
        raise UserError("fire.minutes_per_step: a bank is in steps; expected none, or fire.end")
    _check_horizon(bank.horizon, config, horizon)
    fires: list[np.ndarray] = []
    for times in bank.fires:
        try:
            fires.append(on_grid(map_of_grid(times), config, grid, horizon))
        except UserError as error:
            raise UserError(f"fire {len(fires)}: {error}") from None
    return fires, f"a bank of {len(fires)} fires, in steps", ()


def _check_horizon(written: int | None, config: FileFireConfig, horizon: int) -> None:
    """Checks that a bank whose times stay steps was written for this horizon."""
    in_steps = config.start is config.end is None
    if in_steps and written not in (None, horizon):
        raise UserError(
            f"its fires are of {written} steps, env.horizon is {horizon}; expected "
            f"env.horizon={written}, or fire.end={written} to stretch them over {horizon} steps"
        )


def _read_one(path: Path, kind: formats.Format | None, config: FileFireConfig) -> Source:
    """Returns the fire of a file with one fire."""
    if kind is formats.GEOTIFF:
        return read_geotiff(path, config.units, config.crs)
    if kind is formats.ASCII:
        return read_ascii(path, config.units, config.crs)
    if kind is formats.POINTS:
        return read_front_points(path, config.units or "steps")
    return read_perimeters(path, config)


class FireSets(NamedTuple):
    """Training, validation and test fires, float32 [fires, X, Y] each."""

    train: Tensor
    validation: Tensor
    test: Tensor


def fire_sets(config: FileFireConfig, grid: tuple[int, int], horizon: int) -> FireSets:
    """Returns the fires from the run's copy if it has this grid and horizon, else from the files.

    Raises:
        UserError: one line that names the file and the mistake in it.
    """
    saved = _read_copy(config, grid, horizon)
    if saved is not None:
        return saved
    if config.sha256 is not None:
        with_checksum(config)
    fires = read_fires(config, grid, horizon)
    train, validation, test = _divide(len(fires), test_file=config.test is not None)
    if config.test is None:
        return FireSets(fires[train], fires[validation], fires[test])
    other = dataclasses.replace(config, path=config.test)
    return FireSets(fires[train], fires[validation], read_fires(other, grid, horizon))


def _divide(count: int, *, test_file: bool) -> tuple[list[int], list[int], list[int]]:
    """Divides the fires of a file into training, validation and test fires.

    Of five or more fires every fifth is a test fire and every fifth a validation fire. Of fewer
    the last is the test fire and the last but one the validation fire. A set without a fire shares
    the last one, so the only fire of a file is in all three sets.

    Args:
        count: number of fires in the file.
        test_file: whether another file holds the test fires.
    """
    fires = list(range(count))
    many = count >= _EVERY
    test = [i for i in fires if i % _EVERY == _TEST] if many else fires[-1:]
    if test_file:
        test = []
    rest = [i for i in fires if i not in test] or fires
    validation = [i for i in rest if i % _EVERY == _VALIDATION] if many else rest[-1:]
    train = [i for i in rest if i not in validation] or rest
    return train, validation, test


def with_checksum(config: FileFireConfig) -> FileFireConfig:
    """Computes the checksums of the files and returns the scenario with them.

    Raises:
        UserError: a file is missing, or has another checksum than the scenario.
    """
    test = config.test and _checksum(config.test, config.test_sha256)
    digest = _checksum(config.path, config.sha256)
    return dataclasses.replace(config, sha256=digest, test_sha256=test)


def _checksum(file: str, expected: str | None) -> str:
    path = Path(file).expanduser()
    try:
        digest = formats.digest(path)
    except UserError as error:
        raise UserError(f"{printable(str(path))}: {error}") from None
    if expected not in (None, digest):
        raise UserError(
            f"{printable(str(path))}: has changed: its SHA-256 is {digest[:12]}..., in the run "
            f"{str(expected)[:12]}..."
        )
    return digest


def save_copy(config: FileFireConfig, folder: Path, grid: tuple[int, int], horizon: int) -> None:
    """Writes the run's copy of its fires. Afterwards the run does not need the files.

    Raises:
        UserError: the copy cannot be written.
    """
    fires = fire_sets(config, grid, horizon)
    try:
        content = io.BytesIO()
        arrays = {name: values.numpy() for name, values in fires._asdict().items()}
        np.savez_compressed(content, key=np.array(_key(config, grid, horizon)), **arrays)
        write_sealed(folder / COPY_FILE, content.getbuffer())
    except OSError as error:
        reason = error.strerror or error
        raise UserError(f"{folder / COPY_FILE}: cannot be written: {reason}") from None


def _key(config: FileFireConfig, grid: tuple[int, int], horizon: int) -> str:
    """Returns a hash of all values on which the fires depend."""
    values = dataclasses.asdict(config)
    del values["saved_copy"]
    parts = [READER_VERSION, values, *grid, horizon]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


def _read_copy(config: FileFireConfig, grid: tuple[int, int], horizon: int) -> FireSets | None:
    """Returns the run's copy; None if there is none, it is damaged, or it has another grid."""
    if config.saved_copy is None or config.sha256 is None:
        return None
    content = read_sealed(Path(config.saved_copy), _MAX_COPY)
    if content is None:
        return None
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            if sum(part.file_size for part in arrays.zip.filelist) > _MAX_COPY:
                return None
            if str(arrays["key"]) != _key(config, grid, horizon):
                return None
            fires = [arrays[name] for name in FireSets._fields]
    except Exception:  # damage raises many types
        return None
    for values in fires:
        fits = values.ndim == 3 and values.shape[1:] == tuple(grid) and len(values) > 0
        if not fits or values.dtype != np.float32 or not (values >= 0).all():
            return None
    return FireSets(*(torch.from_numpy(values) for values in fires))
