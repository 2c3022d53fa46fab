"""Caches banks of generated fires in files."""

import dataclasses
import hashlib
import json
import os
import tempfile
import warnings
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from .generator import FireConfig, Split, fire_seeds, make_fires

GENERATOR_VERSION = 1  # raise it whenever the same config and seed give another fire


def cache_folder() -> Path:
    """Returns $EMBERLINK_CACHE, else $XDG_CACHE_HOME/emberlink, else ~/.cache/emberlink."""
    if folder := os.environ.get("EMBERLINK_CACHE"):
        return Path(folder).expanduser()
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "emberlink"


def bank_key(
    config: FireConfig,
    split: Split,
    count: int,
    grid: tuple[int, int],
    horizon: int,
    start: int = 0,
) -> str:
    """Returns a hash of everything that a bank of fires depends on."""
    parts = [GENERATOR_VERSION, dataclasses.asdict(config), split, count, *grid, horizon, start]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:32]


def fire_bank(
    config: FireConfig,
    split: Split,
    count: int,
    grid: tuple[int, int],
    horizon: int,
    *,
    start: int = 0,
    cache_dir: str | os.PathLike[str] | None = None,
) -> Tensor:
    """Returns the first `count` fires of a split, computed once and then read from a file.

    Args:
        config, grid, horizon: as in `make_fires`.
        split, count, start: as in `fire_seeds`.
        cache_dir: folder of the file, `cache_folder()` by default. A damaged file is replaced; a
            folder that cannot be written to costs a warning and the time to compute.

    Returns:
        float32 [count, X, Y] on the CPU, so that every device trains on the same fires.
    """
    seeds = fire_seeds(split, count, start)
    folder = cache_folder() if cache_dir is None else Path(cache_dir)
    file = folder / f"fire-{bank_key(config, split, count, grid, horizon, start)}.npy"
    stored = _read(file, (count, *grid))
    if stored is not None:
        return stored
    fires = make_fires(config, seeds, grid, horizon)
    _write(file, fires)
    return fires


def _read(file: Path, shape: tuple[int, ...]) -> Tensor | None:
    """Returns the bank in a file, None if there is none or it is damaged."""
    if not file.is_file():  # a pipe would never end
        return None
    try:
        # Mapped, so that a header that promises more than there is costs no memory.
        array = np.load(file, mmap_mode="r", allow_pickle=False)
        if array.dtype != np.float32 or array.shape != shape or not (array >= 0).all():
            return None
        return torch.from_numpy(np.array(array))
    except Exception:  # of many types, if the header is damaged
        return None


def _write(file: Path, fires: Tensor) -> None:
    """Writes under a temporary name first, so that no reader finds half a file."""
    temporary = None
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=file.parent, suffix=".tmp", delete=False) as handle:
            temporary = handle.name
            np.save(handle, fires.numpy(), allow_pickle=False)
        os.replace(temporary, file)
    except OSError as error:
        if temporary is not None:
            Path(temporary).unlink(missing_ok=True)
        warnings.warn(f"fires are not cached: cannot write {file}: {error}", stacklevel=3)
