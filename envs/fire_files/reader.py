"""Reads the fires of a file onto a grid, in three sets, and keeps a run's copy of them."""

import dataclasses
import json
import warnings
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from emberlink.envs.fire_files.config import COPY_FILE, FileFireConfig
from emberlink.envs.fire_files.files import TABLES, digest, find_format, naming_file, quiet
from emberlink.envs.fire_files.grid import on_grid
from emberlink.envs.fire_files.rasters import MAX_BANK, read_raster
from emberlink.envs.fire_files.report import Report, ask
from emberlink.envs.utils.atomic_io import open_regular, replaced
from emberlink.envs.utils.errors import UserError, naming, printable

READER_VERSION = 13  # increase it if the same file gives another grid
_OF_TABLES = ("time_field", "time_format", "incident", "incident_field", "where", "radius")


def read_with_summary(
    config: FileFireConfig, grid: tuple[int, int], horizon: int
) -> tuple[Tensor, str]:
    """Returns the fires of `config.path` and the findings about the file; warns of a misreading.

    The fires are float32 [fires, X, Y], in steps; inf never burns.
    """
    report = Report()
    with naming_file(config.path, config.layer) as path, quiet():
        kind = find_format(path)
        table = kind in TABLES
        for key in ("unburned",) if table else _OF_TABLES:
            if getattr(config, key) is not None or (table and config.kind == "masks"):
                others = "rasters" if table else "perimeters"
                raise ask(f"fire.{key} or fire.kind is of {others}", "none for this file")
        if table:
            from emberlink.envs.fire_files.perimeters import read_perimeters

            sources = [read_perimeters(path, kind, config, report)]
        else:
            sources = read_raster(path, kind, config, horizon, report)
        try:
            fires = [on_grid(source, config, grid, horizon, report) for source in sources]
        except UserError as error:
            raise UserError("; ".join([str(error), *report.doubts])) from None
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
    """Computes the checksums of the files and returns the scenario with them."""
    sums: dict[str, str] = {}
    for key, file in (("sha256", config.path), ("test_sha256", config.test)):
        if file is not None:
            with naming_file(file) as path:
                sums[key], known = digest(path), getattr(config, key)
                if known not in (None, sums[key]):
                    now = f"its SHA-256 is {sums[key][:12]}..., in the run {known[:12]}..."
                    raise UserError(f"has changed: {now}")
    return dataclasses.replace(config, **sums)


def save_copy(config: FileFireConfig, folder: Path, grid: tuple[int, int], horizon: int) -> None:
    """Writes the run's copy of its fires. Afterwards the run does not need the files."""
    fires = fire_sets(config, grid, horizon)._asdict()
    arrays: dict[str, Any] = {name: np.asarray(values) for name, values in fires.items()}
    with naming(folder / COPY_FILE):
        folder.mkdir(parents=True, exist_ok=True)
        with replaced(folder / COPY_FILE) as partial, partial.open("wb") as file:
            np.savez_compressed(file, key=np.array(_key(config, grid, horizon)), **arrays)


def _key(config: FileFireConfig, grid: tuple[int, int], horizon: int) -> str:
    """Returns all values on which the fires depend."""
    values = dataclasses.asdict(dataclasses.replace(config, saved_copy=None))
    return json.dumps([READER_VERSION, values, *grid, horizon])


def _read_copy(config: FileFireConfig, grid: tuple[int, int], horizon: int) -> FireSets | None:
    """Returns the run's copy; None if there is none, it is damaged, or it has another grid."""
    most = 12 * MAX_BANK + 1_000_000  # bytes: float32 of the cells of all sets
    # Damage raises many types.
    with suppress(Exception), open_regular(Path(config.saved_copy or ""), most) as file:
        arrays = np.load(file)
        size = sum(part.file_size for part in arrays.zip.filelist)
        if config.sha256 and size <= most and str(arrays["key"]) == _key(config, grid, horizon):
            *fires, about = (arrays[name] for name in FireSets._fields)
            return FireSets(*map(torch.from_numpy, fires), printable(str(about)))  # pyright: ignore
    return None
