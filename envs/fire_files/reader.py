"""Fires from files: what a scenario of kind `file` is, and its grids of arrival times."""

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np
import torch
from pydantic import BeforeValidator, ConfigDict, Field, model_validator
from pydantic.dataclasses import dataclass
from torch import Tensor

from emberlink.envs.config import check_grid
from emberlink.envs.fire.generator import Split
from emberlink.envs.fire_files.bank_reader import MOST_CELLS
from emberlink.envs.utils.atomic_io import open_regular, replaced
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import Name, printable

from . import detect
from .arrival_raster import Source, Units
from .bank_reader import is_bank, read_bands, read_npy
from .episode_crop import on_grid
from .esri_ascii import read_ascii
from .front_points import read_front_points
from .geotiff import read_geotiff
from .perimeters import read_perimeters
from .projection import one_line, quiet

READER_VERSION = 3  # raise it whenever the same file gives another grid
KEPT = "fires.npz"
"""the file of a run folder that holds the run's own copy of its grids"""
_MOST_KEPT = 8 * MOST_CELLS + 1_000_000
"""bytes of that copy, unpacked: float32 of the cells of every set"""
_EVERY, _VALIDATION, _TEST = 5, 3, 4  # remainders of the numbers of validation and test fires
_Number = Annotated[float, Field(allow_inf_nan=False)]
_Time = _Number | Annotated[str, Field(min_length=1, max_length=40)]
_Digest = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
_Text = Annotated[str, Field(min_length=1, max_length=1000)]


def _given(value: Any) -> Any:
    if value is None:
        raise UserError("a file is needed, such as fire.path=ArrivalTime.asc")
    return value


@dataclass(
    frozen=True,
    kw_only=True,
    config=ConfigDict(extra="forbid", strict=True, use_attribute_docstrings=True),
)
class FileFireConfig:
    """Fires read from a file: a raster, perimeters, points of the front, or a bank."""

    kind: Literal["file"] = "file"
    """What tells it from the scenarios of the generator."""
    name: Name = "file"
    """Name of the scenario, that of its file in configs/fire."""
    path: Annotated[_Text, BeforeValidator(_given)]
    """The file; a relative path is relative to the working directory."""
    test: _Text | None = None
    """A second file, of the test fires; without one every fifth fire of the file is a test fire."""
    units: Units | None = None
    """Of the numbers in the file, and of `start` and `end`."""
    start: _Time | None = None
    """Time of step 0, in `units`, or ISO text for calendar times; when the fire began if None."""
    end: _Time | None = None
    """Time of the last step, as `start`; the last arrival if None."""
    minutes_per_step: Annotated[float, Field(gt=0, le=1e9)] | None = None
    """In place of `end`: minutes of the fire per step of the episode."""
    margin: Annotated[float, Field(ge=0, le=0.45)] | None = 0.1
    """Part of the grid left free on each side of the burnt area; None takes the file's extent."""
    ring_width: Annotated[float, Field(gt=0, le=30)] | None = 3.0
    """Width of the burning edge at step 0, cells of a 30-cell side; None burns nothing out."""
    crs: _Text | None = None
    """Projection of a file that carries none, else the one to project it to."""
    time_field: _Text | None = None
    """Column of the perimeters' times; None looks for one that is known."""
    layer: _Text | None = None
    """Layer of a GeoPackage that has several."""
    sha256: _Digest | None = None
    """Of the file's content; a run fills it in when it begins, and then the file must be that."""
    test_sha256: _Digest | None = None
    """Of `test`, likewise."""
    kept: Annotated[str | None, Field(exclude=True)] = dataclasses.field(
        default=None, compare=False
    )
    """A run's own copy of the grids, known where a run folder is opened, never written."""

    @model_validator(mode="after")
    def _one_end(self) -> "FileFireConfig":
        if self.end is not None and self.minutes_per_step is not None:
            raise UserError("end and minutes_per_step: give one of them")
        return self


def read_fires(config: FileFireConfig, grid: tuple[int, int], horizon: int) -> Tensor:
    """The fires of `config.path` on a grid.

    Args:
        config: the scenario.
        grid: (X, Y), each 8 to 256 cells.
        horizon: steps of an episode.

    Returns:
        float32 [fires, X, Y], steps: 0 burns from the start, inf never burns.

    Raises:
        ValueError: one line that names the file and what is wrong with it.
    """
    check_grid(grid)
    path = Path(config.path).expanduser()
    try:
        with quiet():
            found = _gridded(path, config, grid, horizon)
    except ValueError as error:
        raise UserError(f"{printable(str(path))}: {one_line(str(error))}") from None
    except OSError as error:
        reason = error.strerror or error
        raise UserError(f"{printable(str(path))}: cannot be read: {reason}") from None
    except MemoryError:
        raise UserError(f"{printable(str(path))}: not enough memory to read it") from None
    return torch.from_numpy(np.stack(found))


def _gridded(
    path: Path, config: FileFireConfig, grid: tuple[int, int], horizon: int
) -> list[np.ndarray]:
    """The fires in a file, [X, Y] each."""
    kind = detect.find_format(path)
    bank = read_npy if kind is detect.NUMPY else read_bands
    if bank is read_bands and not (kind is detect.GEOTIFF and is_bank(path)):
        return [on_grid(_single(path, kind, config), config, grid, horizon)]
    found: list[np.ndarray] = []
    for source in bank(path):
        try:
            found.append(on_grid(source, config, grid, horizon))
        except ValueError as error:
            raise UserError(f"fire {len(found)}: {error}") from None
    return found


def _single(path: Path, kind: detect.Format, config: FileFireConfig) -> Source:
    """The fire of a file that holds one."""
    if kind is detect.GEOTIFF:
        return read_geotiff(path, config.units, config.crs)
    if kind is detect.ASCII:
        return read_ascii(path, config.units, config.crs)
    if kind is detect.POINTS:
        return read_front_points(path, config.units or "steps")
    return read_perimeters(path, config.units, config.crs, config.time_field, config.layer)


def pinned(config: FileFireConfig) -> FileFireConfig:
    """The scenario with the content of its files written down.

    Raises:
        ValueError: a file is missing, or is not the one that is written down.
    """
    return dataclasses.replace(
        config,
        sha256=_checked(config.path, config.sha256),
        test_sha256=config.test and _checked(config.test, config.test_sha256),
    )


def _checked(file: str, expected: str | None) -> str:
    path = Path(file).expanduser()
    try:
        found = detect.digest(path)
    except ValueError as error:
        raise UserError(f"{printable(str(path))}: {error}") from None
    if expected not in (None, found):
        raise UserError(
            f"{printable(str(path))}: has changed: its content has sha256 {found[:12]}..., that of "
            f"the run {str(expected)[:12]}..."
        )
    return found


def splits(config: FileFireConfig, grid: tuple[int, int], horizon: int) -> dict[Split, Tensor]:
    """Returns the training, validation and test fires, float32 [fires, X, Y] each.

    Read from the run's own copy where there is one for this grid and horizon, else from the files.

    Raises:
        ValueError: one line that names the file and what is wrong with it.
    """
    stored = _read_kept(config, grid, horizon)
    if stored is not None:
        return stored
    if config.sha256 is not None:
        pinned(config)
    fires = read_fires(config, grid, horizon)
    train, validation, test = _indices(len(fires), test_file=config.test is not None)
    if config.test is None:
        test_fires = fires[test]
    else:
        test_fires = read_fires(dataclasses.replace(config, path=config.test), grid, horizon)
    return {"train": fires[train], "validation": fires[validation], "test": test_fires}


def _indices(count: int, *, test_file: bool) -> tuple[list[int], list[int], list[int]]:
    """Divides the fires of a file into training, validation and test fires.

    Of five or more fires every fifth is a test fire and every fifth a validation fire. Of fewer
    the last is the test fire and the last but one the validation fire. Where no fire is left for
    a set, the one before it shares its last: the only fire of a file is in all three sets.

    Args:
        count: number of fires in the file.
        test_file: the test fires are those of another file, so none of this one.
    """
    rest = list(range(count))
    test, several = ([] if test_file else [count - 1]), count >= _EVERY
    if several and not test_file:
        test = [i for i in rest if i % _EVERY == _TEST]
    rest = [i for i in rest if i not in test] or rest
    validation = [i for i in rest if i % _EVERY == _VALIDATION] if several else rest[-1:]
    train = [i for i in rest if i not in validation] or rest
    return train, validation, test


def keep(config: FileFireConfig, folder: Path, grid: tuple[int, int], horizon: int) -> None:
    """Writes the run's own copy of its grids, for which the files are not needed any more.

    Raises:
        ValueError: it cannot be written.
    """
    fires = splits(config, grid, horizon)
    try:
        with replaced(folder / KEPT) as partial, partial.open("wb") as file:
            np.savez_compressed(
                file,
                key=np.array(_key(config, grid, horizon)),
                **{split: values.numpy() for split, values in fires.items()},
            )
    except OSError as error:
        raise UserError(f"{folder / KEPT}: cannot be written: {error.strerror or error}") from None


def _key(config: FileFireConfig, grid: tuple[int, int], horizon: int) -> str:
    """A hash of everything that the grids depend on."""
    values = {name: value for name, value in dataclasses.asdict(config).items() if name != "kept"}
    parts = [READER_VERSION, values, *grid, horizon]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


def _read_kept(
    config: FileFireConfig, grid: tuple[int, int], horizon: int
) -> dict[Split, Tensor] | None:
    """The run's own copy, or None if there is none, or it is damaged or of another grid."""
    if config.kept is None or config.sha256 is None:
        return None
    try:
        with (
            open_regular(Path(config.kept), _MOST_KEPT) as file,
            np.load(file, allow_pickle=False) as found,
        ):
            if sum(part.file_size for part in found.zip.filelist) > _MOST_KEPT:
                return None
            if str(found["key"]) != _key(config, grid, horizon):
                return None
            fires: dict[Split, Any] = {split: found[split] for split in get_args(Split)}
    except Exception:  # numpy and zipfile raise what they like on a damaged file
        return None
    for values in fires.values():
        fits = values.ndim == 3 and values.shape[1:] == tuple(grid) and len(values) > 0
        if not fits or values.dtype != np.float32 or not (values >= 0).all():
            return None
    return {split: torch.from_numpy(values) for split, values in fires.items()}
