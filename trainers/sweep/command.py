"""Runs `emberlink sweep`: trains every combination, and resumes stopped runs."""

from collections.abc import Sequence

import yaml
from rich.console import Console
from rich.table import Table

from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import shown
from emberlink.trainers.sweep import executors
from emberlink.trainers.sweep.jobs import Job, jobs_of
from emberlink.trainers.sweep.plan import plan
from emberlink.trainers.sweep.progress import SweepProgress
from emberlink.trainers.sweep.run_index import RunIndex
from emberlink.trainers.sweep.scheduler import Scheduler

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
        0; 1 if a run failed; 130 or 143 after a signal.

    Raises:
        UserError: an argument is wrong, or the output folder cannot be written.
    """
    executor = executor or _executor([a for a in arguments if _is_executor(a)], at_a_time)
    wanted = jobs_of([a for a in arguments if not _is_executor(a)])
    outputs = {job.output: RunIndex(job.output) for job in wanted}
    if len(outputs) > 1:
        raise UserError(f"output={','.join(map(str, outputs))}: a sweep has one output folder")
    (output, index), *_ = outputs.items()
    index.update()
    for path, why in index.unreadable.items():
        console.print(f"note: {path} is left out: {why}", style="yellow", soft_wrap=True)
    jobs = plan(wanted, index.runs)
    total = sum(len(job.configs) for job in jobs)
    done = sum(len(job.configs) for job in jobs if job.finished)
    console.print(f"{total} runs, of which {done} are finished -> {output}")
    if dry:
        for job in jobs:
            console.print(f"  {job.name}: {job.state}", highlight=False)
        return 0
    scheduler = Scheduler(jobs, index, executor, SweepProgress(console, total, done))
    status = scheduler.work()
    _print_table(scheduler.jobs, console)
    if status == 0:
        console.print(f"compare them with: emberlink compare {output}", soft_wrap=True)
    elif status > 1:
        console.print("stopped; the same command resumes the runs")
    return status


def _is_executor(text: str) -> bool:
    return text.partition("=")[0].split(".")[0] == _EXECUTOR and "=" in text


def _executor(arguments: Sequence[str], workers: int | None) -> executors.Executor:
    """Returns the executor of the arguments `executor=NAME` and `executor.KEY=VALUE`."""
    name = "local"
    settings: dict[str, object] = {} if workers is None else {"workers": workers}
    for text in arguments:
        key, _, value = text.partition("=")
        if key == _EXECUTOR:
            name = value
        else:
            try:
                settings[key.partition(".")[2]] = yaml.safe_load(value)
            except yaml.YAMLError:
                raise UserError(f"{shown(text)!r} is not of the form key=value") from None
    return executors.make(name, settings)


def _print_table(jobs: Sequence[Job], console: Console) -> None:
    """Prints the state and the run folders of each job."""
    table = Table("run", "state")
    table.add_column("folder", overflow="fold")
    for job in jobs:
        state = job.failed or ("finished" if job.finished else "not finished")
        folders = "\n".join(run.folder.path.name for run in job.found.values())
        table.add_row(job.name, state, folders or "-")
    console.print(table)
