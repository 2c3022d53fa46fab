"""Defines the jobs of a sweep, one per combination of values, and finds their runs on disk."""

import hashlib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException

from emberlink.configs import known
from emberlink.envs.utils.atomic_io import inner_folder
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.publish import free_name
from emberlink.trainers.config.compose import flat, resolve, to_values
from emberlink.trainers.config.schema import NOT_LEARNT_WITH, RunConfig
from emberlink.trainers.runs.run_folder import RunFolder
from emberlink.trainers.sweep.executors.base import STATUS, STOP
from emberlink.trainers.training.folders import RunFolders

_MAY_DIFFER = ("output", "seeds", *NOT_LEARNT_WITH)
"""first parts of keys that may differ between configurations of the same run"""
_NAMED = {"setup", "world", "seed", "seeds"}
"""keys whose values are in the name of every job"""
_SEEDS_NAMED = 8
"""seeds that the name of a log can hold; for more, it holds the first"""

Identity = tuple[tuple[str, str], ...]
"""keys and values that identify a run"""


@dataclass(frozen=True)
class FoundRun:
    """A run folder on disk.

    Attributes:
        folder: the run folder.
        stack: seeds that are trained in parallel, including that of this run; empty if it is the
            only one.
    """

    folder: RunFolder
    stack: tuple[int, ...] = ()


@dataclass(eq=False)
class Job:
    """A training process of a sweep: one run, or several seeds trained in parallel.

    Attributes:
        method: the method.
        overrides: `key=value` arguments of a new training.
        configs: the configuration of each seed.
        swept: those of `overrides` that tell the job from the others of the sweep, besides method,
            setup, world and seed.
        found: the runs on disk, by seed.
        log: the file with the output of the process.
        failed: the reason if the process failed, else empty.
        restarts: how often the process was started again after it ended without saving.
    """

    method: str
    overrides: list[str]
    configs: list[RunConfig]
    swept: tuple[str, ...] = ()
    found: dict[int, FoundRun] = field(default_factory=dict)
    log: Path = Path()
    failed: str = ""
    restarts: int = 0

    @property
    def name(self) -> str:
        """The method, the setup, the world, `swept` and the seeds."""
        seeds = ",".join(str(config.seed) for config in self.configs)
        first = self.configs[0]
        return ", ".join([self.method, first.setup, first.world, *self.swept, f"seed {seeds}"])

    @property
    def output(self) -> Path:
        """The folder of the run folders."""
        return Path(self.configs[0].output)

    @property
    def finished(self) -> bool:
        """Whether every seed is fully trained and evaluated."""
        return all(
            config.seed in self.found and is_finished(self.found[config.seed].folder, config)
            for config in self.configs
        )

    @property
    def state(self) -> str:
        """The state: "finished", "unfinished" or "new"."""
        return "finished" if self.finished else "unfinished" if self.found else "new"

    @property
    def newest_state(self) -> str:
        """The name of the newest checkpoint; empty if there is none."""
        states = [state.name for run in self.found.values() for state in run.folder.states()[-1:]]
        return max(states, default="")

    @property
    def identities(self) -> set[Identity]:
        """The identities of all runs that the process trains.

        Seeds that are trained in parallel are resumed together.
        """
        first = self.configs[0]
        seeds = {config.seed for config in self.configs}
        for run in self.found.values():
            seeds |= set(run.stack)
        return {identity(replace(first, seed=seed)) for seed in seeds}

    @property
    def names(self) -> set[str]:
        """The hashes of `identities`."""
        return set(map(hash_of, self.identities))

    @property
    def arguments(self) -> list[str]:
        """The arguments of `emberlink train` for a new or resumed training.

        The arguments of a resumed training contain the device and the given keys that may change,
        such as `logger`.
        """
        first = self.configs[0]
        if first.seed not in self.found:
            return [self.method, *self.overrides]
        given = [text for text in self.overrides if key_of(text) in NOT_LEARNT_WITH]
        if not any(key_of(text) == "device" for text in given):
            given.append(f"device={first.device}")
        return [f"resume={self.found[first.seed].folder.path}", *given]

    def find_runs(self, runs: Mapping[Identity, FoundRun]) -> None:
        """Sets `found` to the runs on disk.

        Args:
            runs: runs in the output folder.
        """
        for config in self.configs:
            run = runs.get(identity(config))
            if run is not None:
                self.found[config.seed] = run

    def create_folders(self) -> int:
        """Creates a folder for each run, and returns their number.

        Each start of the training resumes these runs.
        """
        seeds = tuple(config.seed for config in self.configs)
        stack = seeds if len(seeds) > 1 else ()
        # Not of the arguments: YAML files may have changed since.
        configs = [replace(config, seeds=stack) for config in self.configs]
        RunFolders.create(configs, [folder_name(config) for config in configs]).close()
        return len(configs)

    def open_log(self) -> None:
        """Creates an empty file for the log, so that no other job takes its name, and sets `log`.

        Raises:
            OSError: the file or the folder of the logs cannot be created.
        """
        first, *others = self.configs
        few = len(others) < _SEEDS_NAMED
        rest = [str(other.seed) for other in others] if few else [f"and-{len(others)}-more"]
        seeds = "-".join([str(first.seed), *rest])
        stem = f"{first.setup}_{first.world}_{self.method}_s{seeds}"
        folder = inner_folder(self.output, "logs")
        while True:
            self.log = Path(f"{free_name(folder, stem, ['.txt', STATUS, STOP])}.txt")
            with suppress(FileExistsError):  # another sweep has just taken the name
                return self.log.open("x").close()

    def drop_log(self) -> None:
        """Removes the log if nothing was written to it."""
        if self.log.is_file() and not self.log.stat().st_size:
            self.log.unlink()

    def last_line(self) -> str:
        """Returns the last line of the log, or why there is none."""
        if not self.log.is_file():
            return "there is no log"
        lines = [line.strip() for line in self.log.read_text(errors="replace").splitlines()]
        return next((line for line in reversed(lines) if line), "the log is empty")


def jobs_of(arguments: Sequence[str]) -> list[Job]:
    """Returns a job for every combination of methods and values.

    A run that occurs in several combinations is in one job only.

    Args:
        arguments: names of methods (all methods if there are none), and `key=value` or, in Hydra's
            syntax for several values, `seed=0,1,2` or `seed=range(0,5)`.

    Raises:
        UserError: a key or a value is wrong; the message names it.
    """
    methods = [text for text in arguments if "=" not in text] or list(known("method"))
    choices = [_values(text) for text in arguments if "=" in text]
    several = {key_of(texts[0]) for texts in choices if len(texts) > 1} - _NAMED
    taken: set[tuple[str, Identity]] = set()
    jobs: list[Job] = []
    for method, overrides in product(methods, product(*choices)):
        config = resolve(method, overrides)
        wanted = [replace(config, seed=seed) for seed in config.seeds or (config.seed,)]
        configs = [c for c in wanted if (c.output, identity(c)) not in taken]
        taken |= {(c.output, identity(c)) for c in configs}
        if configs:
            swept = tuple(text for text in overrides if key_of(text) in several)
            jobs.append(job_for(configs, overrides, swept))
    if not jobs:
        raise UserError("no run: a key has no value, as in seed=range(3,3)")
    return jobs


def identity(config: RunConfig) -> Identity:
    """Returns the identity of a configuration's run."""
    values = flat(to_values(config))
    return tuple(
        sorted((k, str(v)) for k, v in values.items() if k.split(".")[0] not in _MAY_DIFFER)
    )


def hash_of(identity: Identity) -> str:
    """Returns a name of a run: a hash of its configuration."""
    return hashlib.sha256(repr(identity).encode()).hexdigest()[:32]


def folder_name(config: RunConfig) -> str:
    """Returns the name of the folder of a run that a sweep creates."""
    name = f"{config.method}_{config.setup}_{config.world}_s{config.seed}"
    return f"{name}_{hash_of(identity(config))[:8]}"


def job_for(configs: list[RunConfig], overrides: Sequence[str], swept: tuple[str, ...] = ()) -> Job:
    """Returns a job that trains several configurations in parallel.

    Args:
        configs: configurations that differ only in their seed.
        overrides: `key=value` arguments of the configurations; their seeds are replaced.
        swept: see `Job`.
    """
    seeds = [config.seed for config in configs]
    if configs[0].seeds and list(configs[0].seeds) != seeds:
        others = [text for text in overrides if key_of(text) not in ("seed", "seeds")]
        overrides = [*others, f"seeds=[{','.join(map(str, seeds))}]"]
    return Job(configs[0].method, list(overrides), configs, swept)


def is_finished(folder: RunFolder, config: RunConfig) -> bool:
    """Returns whether a run has all episodes and an evaluation of its newest checkpoint."""
    try:
        return len(folder.lines()) >= config.episodes and folder.evaluated()
    except (OSError, ValueError):  # resuming the run raises the error
        return False


def key_of(text: str) -> str:
    """Returns the key of `key=value`."""
    return text.partition("=")[0]


def _values(text: str) -> list[str]:
    """Splits `key=1,2` into `key=1` and `key=2`; other texts are unchanged."""
    try:
        parsed = OverridesParser.create().parse_override(text)
        if parsed.is_sweep_override():
            key = parsed.get_key_element()
            return [f"{key}={value}" for value in parsed.sweep_string_iterator()]
    except (HydraException, ValueError, RecursionError):
        pass  # `resolve` raises the error
    return [text]
