"""Manages the run folders of a training, one for each seed."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from emberlink.envs.scenarios import fires_of
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import printable
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.runs.lock import Lock
from emberlink.trainers.runs.run_folder import RunFolder
from emberlink.trainers.runs.safe_read import MAX_YAML, parse_json, read_text
from emberlink.trainers.runs.seal import MAY_CHANGE

LINES = ("metrics.jsonl", "timing.jsonl")
"""files of a run folder with a line for each episode"""
SEED_RUNS = "seed_runs.json"
"""file with the names of the run folders of all seeds, in order"""

Sizes = Mapping[str, int]
"""file -> size in bytes of the files `LINES` of a run folder"""


class RunFolders:
    """The run folders of all seeds, in order, with their configurations and locks.

    Args:
        runs: the run folders; they are locked until `close`.
        configs: configuration of each run.

    Raises:
        UserError: a folder is locked by another process.
    """

    def __init__(self, runs: Sequence[RunFolder], configs: Sequence[RunConfig]):
        self.runs, self.configs = list(runs), list(configs)
        self._locks: list[Lock] = []
        try:
            for run in runs:
                self._locks.append(Lock(run.path))
        except BaseException:
            self.close()
            raise

    @classmethod
    def create(cls, configs: Sequence[RunConfig], names: Sequence[str] = ()) -> "RunFolders":
        """Creates a folder for each seed; the configurations are written last.

        Args:
            configs: configuration of each seed.
            names: names of the folders; made of the date and the configuration if empty.
        """
        given = names or [""] * len(configs)
        runs = [RunFolder.create(c, name) for c, name in zip(configs, given, strict=True)]
        if len(runs) > 1:
            for run in runs:
                run.write(SEED_RUNS, {"folders": [other.path.name for other in runs]})
        grid, horizon = configs[0].env.grid, configs[0].env.horizon
        kept = [
            replace(config, fire=fires_of(config.fire).save_copy(run.path, grid, horizon))
            for config, run in zip(configs, runs, strict=True)
        ]
        for run, config in zip(runs, configs, strict=True):
            run.write_config(config)
        return cls(runs, kept)

    @property
    def names(self) -> list[str]:
        """The names of the folders, with escapes for characters that cannot be printed."""
        return [printable(run.path.name) for run in self.runs]

    def sizes(self) -> list[dict[str, int]]:
        """Flushes the files `LINES` of each folder to the disk and returns their sizes."""
        return [{file: run.size(file) for file in LINES} for run in self.runs]

    def check_lines(self, sizes: Iterable[Sizes], episode: int) -> None:
        """Checks that the files `LINES` have the lines that they had at a checkpoint."""
        for run, size in zip(self.runs, sizes, strict=True):
            run.own_checkpoints()
            for file in LINES:
                run.check_lines(file, size[file], episode)

    def cut_back(self, sizes: Iterable[Sizes], step: int) -> None:
        """Removes lines and checkpoints after a step, and incomplete files."""
        for run, size in zip(self.runs, sizes, strict=True):
            for file in LINES:
                run.cut(file, size[file])
            run.take_away_after(step)

    def append(self, file: str, line: Mapping[str, Any]) -> None:
        """Appends a line to a file in each folder."""
        for run in self.runs:
            run.append(file, line)

    def close(self) -> None:
        """Releases the locks."""
        for lock in self._locks:
            lock.release()
        self._locks = []


def empty(runs: Sequence[RunFolder]) -> list[dict[str, int]]:
    """Returns sizes of 0 for the files `LINES` of each folder."""
    return [dict.fromkeys(LINES, 0) for _ in runs]


def find_runs(folder: Path) -> list[RunFolder]:
    """Returns the run folders of all seeds of a training, in order, given one of them.

    Raises:
        UserError: a folder is missing or a link, or the file that names them is not readable.
    """
    file = folder / SEED_RUNS
    try:
        if not file.exists():
            return [RunFolder(folder)]
        names = _named_in(file)
        runs = [RunFolder(folder.resolve().parent / name) for name in names]
        missing = [run.path for run in runs if not run.path.is_dir()]
        if folder.resolve() not in [run.path for run in runs]:
            raise UserError(folder)
        linked = [run.path for run in runs if run.path.is_symlink()]
    except PermissionError as error:
        raise UserError(f"{file}: cannot be read: {error.strerror}") from None
    except (OSError, ValueError, TypeError, KeyError):
        raise UserError(f"{file}: does not name the folders of the other seeds") from None
    for path in linked:
        raise UserError(f"{path}: cannot be resumed: {file} names it, and it is a link")
    for path in missing:
        raise UserError(f"{path}: is missing; its seed is trained together with {folder}")
    for path in (run.path for run in runs):
        if not _names(path / SEED_RUNS, names):
            raise UserError(f"{path}: {file} names it, and its own {SEED_RUNS} differs")
    return runs


def _named_in(file: Path) -> list[str]:
    """Returns the names of folders in a file `SEED_RUNS`.

    Raises:
        ValueError: a name is not that of a folder beside the file's.
        OSError, TypeError, KeyError: the file cannot be read, or holds something else.
    """
    names = parse_json(read_text(file, MAX_YAML))["folders"]
    if any(name in ("", ".", "..") or Path(name).name != name for name in names):
        raise ValueError(file)
    return names


def _names(file: Path, names: list[str]) -> bool:
    """Returns whether a file `SEED_RUNS` names these folders."""
    try:
        return _named_in(file) == names
    except (OSError, ValueError, TypeError, KeyError):
        return False


def check_seeds(runs: Sequence[RunFolder], config: RunConfig) -> None:
    """Checks that the folders that have a configuration belong to the same training.

    Args:
        runs: the run folders.
        config: configuration of the first folder.

    Raises:
        UserError: a folder belongs to another training.
    """
    seeds = config.seeds or (config.seed,)
    if len(runs) != len(seeds):
        raise UserError(
            f"{runs[0].path}: is of {len(seeds)} seeds, {SEED_RUNS} names {len(runs)} folders"
        )
    for run, seed in zip(runs, seeds, strict=True):
        if not run.has_config():
            continue
        other = run.config(device=config.device)
        # A resume may have ended after it changed some of the files.
        free = {key: getattr(config, key) for key in (*MAY_CHANGE, "evaluation")}
        if replace(other, seed=config.seed, **free) != config:
            raise UserError(f"{run.path / 'config.yaml'}: not of the run of {runs[0].path}")
        if other.seed != seed:
            raise UserError(f"{run.path / 'config.yaml'}: seed={other.seed}, not {seed}")
