"""The run folders of a training: one for each of the seeds that train side by side."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from emberlink.envs.scenarios import fires_of
from emberlink.envs.utils.errors import UserError
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.runs.lock import Lock
from emberlink.trainers.runs.run_folder import RunFolder
from emberlink.trainers.runs.safe_read import MAX_YAML, parse_json, read_text

LINES = ("metrics.jsonl", "timing.jsonl")
"""the files of a run folder that have a line for each episode"""
SEED_RUNS = "seed_runs.json"
"""names the folders of the seeds that train side by side, in order"""

Sizes = Mapping[str, int]
"""bytes of a run folder's files of lines"""


class RunFolders:
    """The run folders of all seeds, in order, with their configurations and locks.

    Args:
        runs: the folders; this process locks them until `close`.
        configs: of each.
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
    def create(cls, configs: Sequence[RunConfig]) -> "RunFolders":
        """Makes a folder for each seed; the configurations are written last, when all are there."""
        runs = [RunFolder.create(config) for config in configs]
        if len(runs) > 1:
            for run in runs:
                run.write(SEED_RUNS, {"folders": [one.path.name for one in runs]})
        for run, config in zip(runs, configs, strict=True):
            run.write_config(config)
        grid, horizon = configs[0].env.grid, configs[0].env.horizon
        kept = [
            replace(config, fire=fires_of(config.fire).save_copy(run.path, grid, horizon))
            for config, run in zip(configs, runs, strict=True)
        ]
        return cls(runs, kept)

    @property
    def names(self) -> list[str]:
        """The names of the folders."""
        return [run.path.name for run in self.runs]

    def sizes(self) -> list[dict[str, int]]:
        """Returns the bytes of each folder's files of lines, flushed to the disk."""
        return [{file: run.size(file) for file in LINES} for run in self.runs]

    def check_lines(self, sizes: Iterable[Sizes], episode: int) -> None:
        """Checks that the files of lines begin as they were when a checkpoint was made."""
        for run, size in zip(self.runs, sizes, strict=True):
            run.own_checkpoints()
            for file in LINES:
                run.check_lines(file, size[file], episode)

    def cut_back(self, sizes: Iterable[Sizes], step: int) -> None:
        """Removes what came after a checkpoint: lines, later checkpoints, half-written files."""
        for run, size in zip(self.runs, sizes, strict=True):
            for file in LINES:
                run.cut(file, size[file])
            run.take_away_after(step)

    def append(self, file: str, line: Mapping[str, Any]) -> None:
        """Adds the same line to a file in each folder."""
        for run in self.runs:
            run.append(file, line)

    def close(self) -> None:
        """Releases the locks."""
        for lock in self._locks:
            lock.release()
        self._locks = []


def empty(runs: Sequence[RunFolder]) -> list[dict[str, int]]:
    """Returns the sizes of files of lines that hold none."""
    return [dict.fromkeys(LINES, 0) for _ in runs]


def find_runs(folder: Path) -> list[RunFolder]:
    """Returns the folders of all seeds that train with the one whose folder is given, in order.

    Raises:
        UserError: one of them is missing, or the file that names them is not readable.
    """
    file = folder / SEED_RUNS
    try:
        if not file.exists():
            return [RunFolder(folder)]
        names = parse_json(read_text(file, MAX_YAML))["folders"]
        runs = [RunFolder(folder.resolve().parent / Path(name).name) for name in names]
        missing = [run.path for run in runs if not run.path.is_dir()]
        if folder.resolve() not in [run.path for run in runs]:
            raise UserError(folder)
        linked = [run.path for run in runs if run.path.is_symlink()]
    except PermissionError as error:
        raise UserError(f"{file}: cannot be read: {error.strerror}") from None
    except (OSError, ValueError, TypeError, KeyError):
        raise UserError(f"{file}: does not name the folders of the other seeds") from None
    for path in linked:
        raise UserError(f"{path}: cannot be resumed: it is a link, named by {file}")
    for path in missing:
        raise UserError(f"{path}: is missing; its seed trains side by side with {folder}")
    return runs


def check_seeds(runs: Sequence[RunFolder], config: RunConfig) -> None:
    """Checks that each folder is of this training, as far as its configuration is written.

    Args:
        runs: the folders.
        config: the first folder's.

    Raises:
        UserError: one is not.
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
        if replace(other, seed=config.seed) != config:
            raise UserError(f"{run.path / 'config.yaml'}: not of the run of {runs[0].path}")
        if other.seed != seed:
            raise UserError(f"{run.path / 'config.yaml'}: seed={other.seed}, not {seed}")
