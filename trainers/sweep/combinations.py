"""Lists the runs of a sweep, one for each combination of values, and finds them on disk."""

import hashlib
import json
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

from emberlink.envs.utils.config_files import known
from emberlink.envs.utils.errors import UserError
from emberlink.trainers.config.compose import resolve, to_values
from emberlink.trainers.config.schema import NOT_LEARNT_WITH, RunConfig
from emberlink.trainers.config.values import parsed
from emberlink.trainers.runs import pretrained
from emberlink.trainers.runs.lock import Lock, LockedError
from emberlink.trainers.runs.run_folder import RunFolder
from emberlink.trainers.sweep.executors.base import Task


@dataclass(eq=False)
class Combination:
    """A run of a sweep."""

    config: RunConfig
    name: str
    """the method, and `key=value` of the keys with several values"""
    overrides: tuple[str, ...] = ()
    """given `key=value` of keys that do not affect learning, for a resumed run"""
    folder: RunFolder | None = None
    failed: str = ""
    """why the training has failed, else empty"""

    @property
    def episodes(self) -> int:
        """Number of finished episodes."""
        return len(self.folder.metrics()) if self.folder else 0

    @property
    def finished(self) -> bool:
        """Whether the run has all episodes and an evaluation of its newest checkpoint."""
        enough = self.episodes >= self.config.episodes
        return self.folder is not None and enough and self.folder.evaluated()

    @property
    def state(self) -> str:
        """The state: "new", "failed", "finished", "running" or "unfinished"."""
        if self.folder is None or self.failed or self.finished:
            return "failed" if self.failed else "finished" if self.folder else "new"
        try:
            if (self.folder.path / "lock").exists():  # also after SIGKILL
                Lock(self.folder.path).release()
        except LockedError:
            return "running"
        return "unfinished"

    @property
    def log(self) -> Path:
        """The file with the output of the trainings."""
        assert self.folder is not None
        path = self.folder.path.absolute()
        return path.parent / "logs" / f"{path.name}.txt"

    def task(self) -> Task:
        """Creates the run folder if there is none, and returns the task that trains the run."""
        if self.folder is None:
            c = self.config
            name = f"{c.method}_{c.setup}_{c.world}_s{c.seed}_{identity(c)[:8]}"
            # From the configuration and not the arguments: YAML files may have changed since.
            self.folder = RunFolder.create(c, name)
        self.log.parent.mkdir(exist_ok=True)
        overrides = (f"device={self.config.device}", *self.overrides)
        return Task(self.folder.path.absolute(), overrides, self.log)


def combinations(arguments: Sequence[str]) -> list[Combination]:
    """Returns each combination of methods, all if none is named, and values of `key=value` once.

    Several values have Hydra's syntax: `seed=0,1,2` or `seed=range(0,5)`.
    """
    methods = [text for text in arguments if "=" not in text] or list(known("method"))
    choices = [_values(text) for text in arguments if "=" in text]
    several = {_key(texts[0]) for texts in choices if len(texts) > 1}
    if "output" in several:
        raise UserError("output: a sweep has one output folder")
    found: dict[str, Combination] = {}
    for method, overrides in product(methods, product(*choices)):
        config = resolve(method, overrides)
        name = ", ".join([method, *(text for text in overrides if _key(text) in several)])
        free = tuple(text for text in overrides if _key(text) in NOT_LEARNT_WITH)
        found.setdefault(identity(config), Combination(config, name, free))
    if not found:
        raise UserError("no run: a key has no value, as in seed=range(3,3)")
    return list(found.values())


def find_folders(wanted: Sequence[Combination], output: Path) -> None:
    """Sets the folder of each run that is in the output folder; warns of what cannot be read.

    A folder belongs to a run if it has the same identity, whatever its name; a finished one first.
    """
    by_identity = {identity(run.config): run for run in wanted}
    for file in sorted(output.glob("*/config.yaml")):
        if pretrained.is_copy(file.parent):
            continue
        try:
            folder = RunFolder(file.parent)
            run = by_identity.get(identity(folder.config()))
        except ValueError as error:
            warnings.warn(f"{file.parent} is left out: {error}", stacklevel=2)
            continue
        if run is not None and not run.finished:
            run.folder = folder


def identity(config: RunConfig) -> str:
    """Returns a hash of the keys and values that tell a run from others."""
    values = to_values(config).items()
    told = {key: value for key, value in values if key not in ("output", *NOT_LEARNT_WITH)}
    return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()


def _key(text: str) -> str:
    return text.partition("=")[0]


def _values(text: str) -> list[str]:
    """Splits `key=1,2` into `key=1` and `key=2` by Hydra's grammar; other texts are unchanged."""
    override = parsed(text)
    if override is None or not override.is_sweep_override():
        return [text]
    return [f"{_key(text)}={value}" for value in override.sweep_string_iterator()]
