"""Many runs: methods x seeds x setups, several at a time, going on where it was stopped."""

import os
import subprocess
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from rich.console import Console
from rich.table import Table

from emberlink.configs import known
from emberlink.envs.utils.atomic_io import inner_folder
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.publish import free_name
from emberlink.trainers.config.compose import flat, resolve, to_values
from emberlink.trainers.config.schema import NOT_LEARNT_WITH, RunConfig
from emberlink.trainers.runs.run_folder import RunFolder
from emberlink.trainers.runs.signals import Interruption

from .progress import SweepProgress

_MAY_DIFFER = ("output", *NOT_LEARNT_WITH)
"""keys in which a run that is there may differ from the one that is wanted"""
_PROGRAM = "from emberlink.trainers.cli.main import main; raise SystemExit(main())"
_BETWEEN_LOOKS = 0.5  # seconds


@dataclass(eq=False)
class Job:
    """One run of a sweep, or one stack of seeds.

    Attributes:
        method: whose recipe.
        overrides: `key=value` of the command line that makes it.
        configs: of each of its seeds.
        folders: the run folders of them that are there, by seed.
        log: where its output goes.
        failed: why it did not come to its end.
    """

    method: str
    overrides: list[str]
    configs: list[RunConfig]
    folders: dict[int, RunFolder] = field(default_factory=dict)
    log: Path = Path()
    failed: str = ""

    @property
    def name(self) -> str:
        """Method, setup and seeds: what tells runs of a sweep apart, as far as it is short."""
        seeds = ",".join(str(config.seed) for config in self.configs)
        return f"{self.method}, {self.configs[0].setup}, seed {seeds}"

    @property
    def finished(self) -> bool:
        """Whether every seed has been trained and evaluated."""
        return len(self.folders) == len(self.configs) and all(
            run.evaluated() for run in self.folders.values()
        )

    @property
    def arguments(self) -> list[str]:
        """Of `emberlink train`: a new run, or going on with that which is there."""
        if self.configs[0].seed in self.folders:
            return [f"resume={self.folders[self.configs[0].seed].path}"]
        return [self.method, *self.overrides]

    def look(self, runs: Iterable[tuple[tuple, RunFolder]]) -> None:
        """Notes which of the run folders are this job's: the newest of each seed."""
        wanted = {_identity(config): config.seed for config in self.configs}
        for identity, run in runs:
            if identity in wanted:
                self.folders[wanted[identity]] = run


def jobs_of(arguments: Sequence[str]) -> list[Job]:
    """Every combination of the methods and of the values that keys are given.

    Args:
        arguments: methods, all if there are none, and `key=value` or `key=value,value,...`, as
            Hydra writes several (`seed=0,1,2`, `seed=range(0,5)`).

    Raises:
        ValueError: one line that names what is wrong with the first combination that is.
    """
    methods = [text for text in arguments if "=" not in text] or list(known("method"))
    choices = [_values(text) for text in arguments if "=" in text]
    jobs: dict[tuple, Job] = {}
    for method, overrides in product(methods, product(*choices)):
        config = resolve(method, overrides)
        seeds = config.seeds or (config.seed,)
        configs = [replace(config, seed=seed) for seed in seeds]
        jobs.setdefault(_identity(configs[0]), Job(method, list(overrides), configs))
    return list(jobs.values())


def sweep(
    arguments: Sequence[str], console: Console, *, at_a_time: int | None = None, dry: bool = False
) -> int:
    """Trains and evaluates what is not yet there.

    Args:
        arguments: as in `jobs_of`.
        console: where progress is shown.
        at_a_time: runs side by side; as many as there are cores if None. The cores are shared out.
        dry: only says what would be done.

    Returns:
        0; 1 where a run failed; 130 or 143 where a signal ended it.
    """
    jobs = jobs_of(arguments)
    output = Path(jobs[0].configs[0].output)
    for job in jobs:
        job.look(_runs_in(Path(job.configs[0].output)))
    left = [job for job in jobs if not job.finished]
    console.print(f"{len(jobs)} runs, of which {len(jobs) - len(left)} are finished -> {output}")
    if dry:
        for job in jobs:
            state = "finished" if job.finished else "goes on" if job.folders else "new"
            console.print(f"  {job.name}: {state}", highlight=False)
        return 0
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    workers = min(at_a_time or cores or 1, max(len(left), 1))
    status = _Team(left, workers, max((cores or 1) // workers, 1), len(jobs), console).work()
    _print_table(jobs, console)
    if status == 0:
        console.print(f"compare them with: emberlink compare {output}", soft_wrap=True)
    elif status > 1:
        console.print("stopped; the same command goes on")
    return status


class _Team:
    """Processes that train, a number of them at a time."""

    def __init__(self, jobs: list[Job], workers: int, threads: int, all_jobs: int, console):
        self._left, self._workers, self._threads = list(jobs), workers, threads
        self._running: dict[Job, subprocess.Popen] = {}
        self._failed = 0
        self._progress = SweepProgress(console, all_jobs, all_jobs - len(jobs))
        self._stopping = False

    def work(self) -> int:
        interruption = Interruption(self._stop)
        try:
            with interruption, self._progress:
                while self._running or (self._left and not self._stopping):
                    while self._left and len(self._running) < self._workers and not self._stopping:
                        self._start(self._left.pop(0))
                    time.sleep(_BETWEEN_LOOKS)
                    self._look()
        finally:
            # A second signal: they are told once more, and do not wait then.
            self._stop()
            for process in self._running.values():
                process.wait()
        return interruption.status if interruption.received else int(self._failed > 0)

    def _start(self, job: Job) -> None:
        config = job.configs[0]
        output = Path(config.output)
        try:
            output.mkdir(parents=True, exist_ok=True)
            logs = inner_folder(output, "logs")
            stem = f"{config.setup}_{job.method}_s" + "-".join(str(c.seed) for c in job.configs)
            job.log = Path(f"{free_name(logs, stem, ['.txt'])}.txt")
            with job.log.open("x") as log:
                # A session of its own: Ctrl-C is for the sweep, which tells them to save.
                self._running[job] = subprocess.Popen(
                    [sys.executable, "-c", _PROGRAM, "train", *job.arguments],
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=subprocess.STDOUT,
                    env={"OMP_NUM_THREADS": str(self._threads), **os.environ, "COLUMNS": "120"},
                    start_new_session=True,
                )
        except OSError as error:
            raise UserError(f"output={config.output}: {error.strerror or error}") from None
        self._progress.begin(job)

    def _look(self) -> None:
        for job, process in list(self._running.items()):
            if len(job.folders) < len(job.configs):
                job.look(_runs_in(Path(job.configs[0].output)))
            self._progress.follow(job)
            status = process.poll()
            if status is None:
                continue
            del self._running[job]
            job.look(_runs_in(Path(job.configs[0].output)))
            if not self._stopping and not job.finished:
                self._failed += 1
                job.failed = f"exit status {status}: {_last_line(job.log)} (all of it: {job.log})"
            self._progress.end(job, job.failed or ("finished" if job.finished else "stopped"))

    def _stop(self) -> None:
        self._stopping = True
        for process in self._running.values():
            process.terminate()


def _values(text: str) -> list[str]:
    """`key=1,2` -> `key=1` and `key=2`; what is not several values is left as it is."""
    try:
        parsed = OverridesParser.create().parse_override(text)
        if parsed.is_sweep_override():
            return [f"{parsed.get_key_element()}={one}" for one in parsed.sweep_string_iterator()]
    except HydraException:
        pass  # `resolve` says what is wrong with it
    return [text]


def _identity(config: RunConfig) -> tuple:
    """What makes two runs the same run."""
    values = flat(to_values(config))
    return tuple(sorted((k, str(v)) for k, v in values.items() if k not in _MAY_DIFFER))


def _runs_in(output: Path) -> list[tuple[tuple, RunFolder]]:
    """The run folders there, oldest first, with what each of them is."""
    found = []
    for file in sorted(output.glob("*/config.yaml")):
        run = RunFolder(file.parent)
        try:
            found.append((_identity(run.config()), run))
        except ValueError:
            continue  # of another version, or not one of ours
    return found


def _last_line(log: Path) -> str:
    lines = [line.strip() for line in log.read_text(errors="replace").splitlines()]
    return next((line for line in reversed(lines) if line), "nothing was said")


def _print_table(jobs: Sequence[Job], console: Console) -> None:
    table = Table("run", "state")
    table.add_column("folder", overflow="fold")
    for job in jobs:
        state = job.failed or ("finished" if job.finished else "not finished")
        folders = "\n".join(run.path.name for run in job.folders.values())
        table.add_row(job.name, state, folders or "-")
    console.print(table)
