"""Runs `emberlink sweep`: trains every combination, and resumes stopped runs."""

import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from rich.console import Console
from rich.table import Table

from emberlink.envs.utils.errors import UserError
from emberlink.trainers.sweep import executors
from emberlink.trainers.sweep.jobs import Identity, Job, identity, jobs_of
from emberlink.trainers.sweep.manifest import Manifest
from emberlink.trainers.sweep.plan import plan, stacked
from emberlink.trainers.sweep.progress import SweepProgress
from emberlink.trainers.sweep.run_index import RunIndex
from emberlink.trainers.sweep.scheduler import Scheduler
from emberlink.trainers.tracking import loggers
from emberlink.trainers.training.setup import check_setup

_EXECUTOR = "executor"


def sweep(
    arguments: Sequence[str],
    console: Console,
    *,
    at_a_time: int | None = None,
    dry: bool = False,
    executor: executors.Executor | None = None,
) -> int:
    """Trains and evaluates the runs that are not finished.

    Args:
        arguments: see `jobs_of`; and `executor=NAME`, `executor.KEY=VALUE`.
        console: shows the progress and a table at the end.
        at_a_time: number of runs in parallel; replaces `executor.workers`.
        dry: whether to print the state of each run and do nothing else.
        executor: runs the trainings; replaces the executor of the arguments.

    Returns:
        0; 1 if a run failed; 128 and the number of a signal, such as 130, after it.

    Raises:
        UserError: an argument is wrong, or the output folder cannot be written.
    """
    name, executor = _executor(arguments, at_a_time) if executor is None else ("", executor)
    wanted = jobs_of([a for a in arguments if not _is_executor(a)])
    outputs = {job.output: RunIndex(job.output) for job in wanted}
    if len(outputs) > 1:
        raise UserError(f"output={','.join(map(str, outputs))}: a sweep has one output folder")
    (output, index), *_ = outputs.items()
    index.update()
    for path, why in index.unreadable.items():
        console.print(f"note: {path} is left out: {why}", style="yellow", soft_wrap=True)
    jobs = stacked(plan(wanted, index.runs), executor.seeds)
    _check(jobs)
    total = sum(len(job.configs) for job in jobs)
    done = sum(len(job.configs) for job in jobs if job.finished)
    console.print(f"{total} runs, of which {done} are finished -> {output}", soft_wrap=True)
    if dry:
        for job in jobs:
            console.print(f"  {job.name}: {job.state}", highlight=False, soft_wrap=True)
        return 0
    for job in jobs:
        loggers.check_installed(job.configs[0])
    progress = SweepProgress(console, total, done)
    scheduler = Scheduler(jobs, index, executor, progress, Manifest(output, name))
    status = scheduler.work()
    _print_table(scheduler.jobs, console)
    _print_end(status, scheduler.left, output, console)
    return status


def _check(jobs: Sequence[Job]) -> None:
    """Checks that new jobs can be trained; those that differ in their seeds only, once.

    Raises:
        UserError: one cannot.
    """
    checked: set[tuple[int, Identity]] = set()
    for job in jobs:
        seeds = [config.seed for config in job.configs]
        config = replace(job.configs[0], seeds=tuple(seeds) if len(seeds) > 1 else ())
        name = len(seeds), identity(replace(config, seed=0))
        if job.state != "new" or name in checked:
            continue
        checked.add(name)
        try:
            check_setup(config)
        except UserError as error:
            raise UserError(f"{job.name}: {error}") from None


def _print_end(status: int, left: int, output: Path, console: Console) -> None:
    """Prints the command that follows a sweep.

    Args:
        status: as of `sweep`.
        left: number of trainings that still run or wait.
        output: folder of the runs.
        console: prints the text.
    """
    where = shlex.quote(str(output))
    if status == 0:
        console.print(f"compare them with: emberlink compare {where}", soft_wrap=True)
    elif left:
        console.print(
            f"{left} trainings are left running or queued; "
            f"show their states with: emberlink sweep status {where}",
            soft_wrap=True,
        )
    elif status > 1:
        console.print("stopped; the same command resumes the runs")


def _is_executor(text: str) -> bool:
    return text.partition("=")[0].split(".")[0] == _EXECUTOR and "=" in text


def _executor(arguments: Sequence[str], workers: int | None) -> tuple[str, executors.Executor]:
    """Returns the name and the executor of `executor=NAME` and `executor.KEY=VALUE`."""
    name = "local"
    texts: dict[str, str] = {} if workers is None else {"workers": str(workers)}
    for text in filter(_is_executor, arguments):
        key, _, value = text.partition("=")
        if key == _EXECUTOR:
            name = value
        else:
            texts[key.partition(".")[2]] = value
    return name, executors.from_texts(name, texts)


def _print_table(jobs: Sequence[Job], console: Console) -> None:
    """Prints the state and the folder of each run, and why jobs failed."""
    table = Table("run", "state", "folder")
    for job in jobs:
        state = "failed" if job.failed else "finished" if job.finished else "not finished"
        for config in job.configs:
            run = job.found.get(config.seed)
            name = replace(job, configs=[config]).name
            table.add_row(name, state, run.folder.path.name if run else "-")
    console.print(table)
    for job in jobs:
        if job.failed:
            console.print(f"{job.name}: {job.failed}", soft_wrap=True)
