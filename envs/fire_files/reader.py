"""Reads the fires of a file onto a grid, in three sets, and keeps a run's copy of them."""

import dataclasses
import json
import warnings
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from emberlink.envs.fire_files.config import COPY_FILE, FileFireConfig
from emberlink.envs.fire_files.files import TABLES, digest, find_format, named
from emberlink.envs.fire_files.grid import on_grid
from emberlink.envs.fire_files.rasters import read_raster
from emberlink.envs.fire_files.report import Report
from emberlink.envs.utils.atomic_io import write_bytes
from emberlink.envs.utils.errors import UserError, naming, printable

_OF_TABLES = ("time_field", "incident", "incident_field", "where", "radius")


def read_with_summary(
    config: FileFireConfig, grid: tuple[int, int], horizon: int
) -> tuple[Tensor, str]:
    """Returns the fires of `config.path` and the findings about the file; warns of a misreading.

    The fires are float32 [fires, X, Y], in steps; inf never burns.
    """
    report = Report()
    with named(config.path, config.layer) as path:
        kind = find_format(path)
        for key in ("unburned",) if kind in TABLES else _OF_TABLES:
            if getattr(config, key) is not None:
                raise UserError(f"fire.{key} has no effect on files of this kind")
        if kind in TABLES:
            from emberlink.envs.fire_files.perimeters import read_perimeters

            sources = [read_perimeters(path, kind, config, report)]
        else:
            sources = read_raster(path, kind, config, horizon, report)
        fires = [on_grid(source, config, grid, horizon, report) for source in sources]
    cells = [int(np.isfinite(fire).sum()) for fire in fires]
    burn = " to ".join(map(str, sorted({min(cells), max(cells)})))
    facts = [*report.facts, f"{burn} of {' x '.join(map(str, grid))} cells burn"]
    summary, doubts = printable("; ".join(facts)), printable("; ".join(report.doubts))
    if doubts:
        warnings.warn(f"{printable(str(path))}: {doubts}; read: {summary}", stacklevel=3)
    return torch.from_numpy(np.stack(fires)), summary


class FireSets(NamedTuple):
    """Training, validation and test fires, float32 [fires, X, Y] each, and the findings."""

    train: Tensor
    validation: Tensor
    test: Tensor
    about: str


def fire_sets(config: FileFireConfig, grid: tuple[int, int], horizon: int) -> FireSets:
    """Returns the fires from the run's copy if it has this grid and horizon, else from files."""
    if (saved := _read_copy(config, grid, horizon)) is not None:
        return saved
    if config.sha256 is not None:
        with_checksum(config)
    fires, about = read_with_summary(config, grid, horizon)
    train, validation, test = _divide(len(fires), test_file=config.test is not None)
    tests = fires[test]
    if config.test is not None:
        other = dataclasses.replace(config, path=config.test)
        tests, more = read_with_summary(other, grid, horizon)
        about = f"{about}; test fires: {more}"
    return FireSets(fires[train], fires[validation], tests, about)


def _divide(count: int, *, test_file: bool) -> tuple[list[int], list[int], list[int]]:
    """Divides fires by number modulo 5; of fewer than 5, the last two validate and test."""
    fires = list(range(count))
    test = fires[4::5] or fires[-1:]
    rest = fires if test_file else [i for i in fires if i not in test] or fires
    validation = [i for i in rest if i % 5 == 3] if count >= 5 else rest[-1:]
    return [i for i in rest if i not in validation] or rest, validation, test


def with_checksum(config: FileFireConfig) -> FileFireConfig:
    """Computes the checksum of the files and returns the scenario with it."""
    files = [*filter(None, (config.path, config.test))]
    now, known = digest(files), config.sha256
    if known not in (None, now):
        seen = f"the SHA-256 is {now[:12]}..., in the run {known[:12]}..."
        raise UserError(f"{printable(' or '.join(files))}: has changed: {seen}")
    return dataclasses.replace(config, sha256=now)


def save_copy(config: FileFireConfig, folder: Path, grid: tuple[int, int], horizon: int) -> None:
    """Writes the run's copy of its fires. Afterwards the run does not need the files."""
    *fires, about = fire_sets(config, grid, horizon)
    header = {"key": _key(config, grid, horizon), "about": about}
    content = save(dict(zip(FireSets._fields, fires, strict=False)), header)
    with naming(folder / COPY_FILE):
        write_bytes(folder / COPY_FILE, content)


def _key(config: FileFireConfig, grid: tuple[int, int], horizon: int) -> str:
    """Returns all values on which the fires depend."""
    values = dataclasses.asdict(dataclasses.replace(config, saved_copy=None))
    return json.dumps([values, *grid, horizon])


def _read_copy(config: FileFireConfig, grid: tuple[int, int], horizon: int) -> FireSets | None:
    """Returns the run's copy; None if there is none, it is damaged, or it has another grid."""
    with suppress(OSError, SafetensorError), safe_open(config.saved_copy or "", "pt") as file:
        header = file.metadata() or {}
        if header.get("key") == _key(config, grid, horizon):
            train, validation, test = map(file.get_tensor, FireSets._fields[:3])
            return FireSets(train, validation, test, printable(header["about"]))
    return None
