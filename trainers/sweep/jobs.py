"""The jobs of a sweep: every combination of methods and values."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException

from emberlink.configs import known
from emberlink.trainers.config.compose import flat, resolve, to_values
from emberlink.trainers.config.schema import NOT_LEARNT_WITH, RunConfig
from emberlink.trainers.runs.run_folder import RunFolder

_MAY_DIFFER = ("output", "seeds", *NOT_LEARNT_WITH)
"""first parts of the keys in which two configurations of the same run may differ"""

Identity = tuple[tuple[str, str], ...]
"""keys and values that are equal for two configurations of the same run"""


@dataclass(frozen=True)
class FoundRun:
    """A run folder on disk.

    Attributes:
        folder: the run folder.
        stack: the seeds that are trained side by side with it, its own included; empty where it is
            trained alone.
    """

    folder: RunFolder
    stack: tuple[int, ...] = ()


@dataclass(eq=False)
class Job:
    """A training process of a sweep: one run, or several seeds trained as one stack.

    Attributes:
        method: the recipe.
        overrides: `key=value` arguments of a new training.
        configs: the configuration of each seed.
        found: the runs on disk, by seed.
        log: the file with the output of the process.
        failed: the reason if the process failed, else empty.
    """

    method: str
    overrides: list[str]
    configs: list[RunConfig]
    found: dict[int, FoundRun] = field(default_factory=dict)
    log: Path = Path()
    failed: str = ""

    @property
    def name(self) -> str:
        """The method, the setup and the seeds."""
        seeds = ",".join(str(config.seed) for config in self.configs)
        return f"{self.method}, {self.configs[0].setup}, seed {seeds}"

    @property
    def output(self) -> Path:
        """The folder of the run folders."""
        return Path(self.configs[0].output)

    @property
    def finished(self) -> bool:
        """Whether every seed has been trained to its end and evaluated."""
        return all(
            config.seed in self.found and is_finished(self.found[config.seed].folder, config)
            for config in self.configs
        )

    @property
    def state(self) -> str:
        """The state in a word or two: finished, unfinished or new."""
        return "finished" if self.finished else "unfinished" if self.found else "new"

    @property
    def identities(self) -> set[Identity]:
        """The runs that the process trains: a stack is resumed as a whole."""
        first = self.configs[0]
        seeds = {config.seed for config in self.configs}
        for run in self.found.values():
            seeds |= set(run.stack)
        return {identity(replace(first, seed=seed)) for seed in seeds}

    @property
    def arguments(self) -> list[str]:
        """The arguments of `emberlink train`: of a new training, or of one to resume.

        A resumed training is given the device and those keys of the command line that it may be
        given anew, such as `logger`.
        """
        first = self.configs[0]
        if first.seed not in self.found:
            return [self.method, *self.overrides]
        given = [text for text in self.overrides if key_of(text) in NOT_LEARNT_WITH]
        if not any(key_of(text) == "device" for text in given):
            given.append(f"device={first.device}")
        return [f"resume={self.found[first.seed].folder.path}", *given]

    def find_runs(self, runs: Mapping[Identity, FoundRun]) -> None:
        """Looks up the run of each seed that is on disk.

        Args:
            runs: the runs of the output folder.
        """
        for config in self.configs:
            run = runs.get(identity(config))
            if run is not None:
                self.found[config.seed] = run


def jobs_of(arguments: Sequence[str]) -> list[Job]:
    """Returns a job for every combination of the methods and of the values that keys are given.

    A run that occurs twice is kept once, also where it is a seed of two stacks.

    Args:
        arguments: methods, all if there are none, and `key=value` or `key=value,value,...` in
            Hydra's form for several values (`seed=0,1,2`, `seed=range(0,5)`).

    Raises:
        UserError: a combination is wrong; one line that names the key and the value.
    """
    methods = [text for text in arguments if "=" not in text] or list(known("method"))
    choices = [_values(text) for text in arguments if "=" in text]
    taken: set[tuple[str, Identity]] = set()
    jobs: list[Job] = []
    for method, overrides in product(methods, product(*choices)):
        config = resolve(method, overrides)
        wanted = [replace(config, seed=seed) for seed in config.seeds or (config.seed,)]
        configs = [one for one in wanted if (one.output, identity(one)) not in taken]
        taken |= {(one.output, identity(one)) for one in configs}
        if configs:
            jobs.append(job_for(configs, overrides))
    return jobs


def identity(config: RunConfig) -> Identity:
    """Returns the keys and values that two configurations of the same run have in common."""
    values = flat(to_values(config))
    return tuple(
        sorted((k, str(v)) for k, v in values.items() if k.split(".")[0] not in _MAY_DIFFER)
    )


def job_for(configs: list[RunConfig], overrides: Sequence[str]) -> Job:
    """Returns the job that trains the seeds of `configs`.

    Args:
        configs: configurations that differ in their seed alone.
        overrides: `key=value` arguments that make them, whatever seeds these name.
    """
    seeds = [config.seed for config in configs]
    if configs[0].seeds and list(configs[0].seeds) != seeds:
        others = [text for text in overrides if key_of(text) not in ("seed", "seeds")]
        overrides = [*others, f"seeds=[{','.join(map(str, seeds))}]"]
    return Job(configs[0].method, list(overrides), configs)


def is_finished(folder: RunFolder, config: RunConfig) -> bool:
    """Returns whether a run has all its episodes and an evaluation of its newest checkpoint."""
    try:
        return len(folder.lines()) >= config.episodes and folder.evaluated()
    except (OSError, ValueError):  # resuming the run raises the error
        return False


def key_of(text: str) -> str:
    """Returns the key of `key=value`."""
    return text.partition("=")[0]


def _values(text: str) -> list[str]:
    """Returns `key=1` and `key=2` for `key=1,2`, and any other text as it is."""
    try:
        parsed = OverridesParser.create().parse_override(text)
        if parsed.is_sweep_override():
            key = parsed.get_key_element()
            return [f"{key}={value}" for value in parsed.sweep_string_iterator()]
    except HydraException:
        pass  # `resolve` raises the error
    return [text]
