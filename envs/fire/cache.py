"""Caches banks of generated fires in files."""

import contextlib
import dataclasses
import hashlib
import json
import os
import warnings
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from emberlink.envs.fire.generator import GeneratedConfig, Split, fire_seeds, make_fires
from emberlink.envs.utils.atomic_io import replaced, user_path

GENERATOR_VERSION = 1  # increase it if the same config and seed give another fire


def cache_folder() -> Path:
    """Returns $EMBERLINK_CACHE, else $XDG_CACHE_HOME/emberlink, else ~/.cache/emberlink."""
    if folder := os.environ.get("EMBERLINK_CACHE"):
        return user_path(folder)
    return user_path(os.environ.get("XDG_CACHE_HOME") or "~/.cache") / "emberlink"


def fire_bank(
    config: GeneratedConfig, split: Split, count: int, grid: tuple[int, int], horizon: int
) -> Tensor:
    """Returns the first `count` fires of a split, computed once and then read from a file.

    A file in `cache_folder()` that cannot be read is replaced. If the folder cannot be written to,
    a warning is issued and the fires are computed each time.

    Args:
        config, grid, horizon: as in `make_fires`.
        split, count: as in `fire_seeds`.

    Returns:
        As `make_fires`, on the CPU, so that every device trains on the same fires.
    """
    ranges = dataclasses.asdict(config)
    ranges.pop("burn_time", None)  # with which the arrival times do not change
    key = json.dumps([GENERATOR_VERSION, ranges, split, count, *grid, horizon])
    name = f"fire-{hashlib.sha256(key.encode()).hexdigest()[:32]}.npy"
    file = cache_folder() / name
    with contextlib.suppress(Exception):  # a damaged header raises many types
        return torch.from_numpy(np.load(file, allow_pickle=False))
    fires = make_fires(config, fire_seeds(split, count, config.test_seed), grid, horizon)
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with replaced(file) as partial, partial.open("wb") as handle:
            np.save(handle, fires.numpy(), allow_pickle=False)
    except OSError as error:
        warnings.warn(f"fires are not cached: cannot write {file}: {error}", stacklevel=2)
    return fires
