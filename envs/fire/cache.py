"""Caches banks of generated fires in files."""

import dataclasses
import hashlib
import io
import json
import math
import os
import warnings
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from emberlink.envs.fire.generator import GeneratedConfig, Split, fire_seeds, make_fires
from emberlink.envs.fire.reaction import ReactionConfig
from emberlink.envs.utils.atomic_io import read_sealed, write_sealed

GENERATOR_VERSION = 1  # increase it if the same config and seed give another fire
_MAX_HEADER = 10_000  # bytes of NumPy's format before the numbers


def cache_folder() -> Path:
    """Returns $EMBERLINK_CACHE, else $XDG_CACHE_HOME/emberlink, else ~/.cache/emberlink."""
    if folder := os.environ.get("EMBERLINK_CACHE"):
        return Path(folder).expanduser()
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "emberlink"


def bank_key(
    config: GeneratedConfig,
    split: Split,
    count: int,
    grid: tuple[int, int],
    horizon: int,
) -> str:
    """Returns a hash of all values on which a bank of fires depends."""
    ranges = dataclasses.asdict(config)
    ranges.pop("burn_time", None)
    parts = [GENERATOR_VERSION, ranges, split, count, *grid, horizon]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:32]


def fire_bank(
    config: GeneratedConfig,
    split: Split,
    count: int,
    grid: tuple[int, int],
    horizon: int,
) -> Tensor:
    """Returns the first `count` fires of a split, computed once and then read from a file.

    The file, in `cache_folder()`, ends with the SHA-256 of its content. A damaged file is replaced.
    If the folder cannot be written to, a warning is issued and the fires are computed each time.

    Args:
        config, grid, horizon: as in `make_fires`.
        split, count: as in `fire_seeds`.

    Returns:
        As `make_fires`, on the CPU, so that every device trains on the same fires.
    """
    seeds = fire_seeds(split, count)
    file = cache_folder() / f"fire-{bank_key(config, split, count, grid, horizon)}.npy"
    times = (2,) if isinstance(config, ReactionConfig) else ()
    stored = _read(file, (count, *times, *grid))
    if stored is not None:
        return stored
    fires = make_fires(config, seeds, grid, horizon)
    _write(file, fires)
    return fires


def _read(file: Path, shape: tuple[int, ...]) -> Tensor | None:
    """Returns the bank in a file; None if there is no file or its content has changed."""
    content = read_sealed(file, 4 * math.prod(shape) + _MAX_HEADER)
    if content is None:
        return None
    try:
        array = np.load(io.BytesIO(content), allow_pickle=False)
    except Exception:  # a damaged header raises many types
        return None
    if array.dtype != np.float32 or array.shape != shape or not (array >= 0).all():
        return None
    return torch.from_numpy(array)


def _write(file: Path, fires: Tensor) -> None:
    """Writes a bank atomically. Warns if the folder cannot be written to."""
    content = io.BytesIO()
    np.save(content, fires.numpy(), allow_pickle=False)
    try:
        write_sealed(file, content.getbuffer())
    except OSError as error:
        warnings.warn(f"fires are not cached: cannot write {file}: {error}", stacklevel=3)
