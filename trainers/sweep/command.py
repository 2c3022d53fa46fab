"""Runs `emberlink sweep`: trains every combination that is not finished."""

import shlex
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table

from emberlink.envs.utils.atomic_io import user_path
from emberlink.envs.utils.errors import UserError
from emberlink.trainers.runs.lock import Lock, LockedError
from emberlink.trainers.runs.run_folder import RunFolder
from emberlink.trainers.sweep.combinations import (
    Combination,
    combinations,
    find_folders,
    lines_of,
    without_seed,
)
from emberlink.trainers.sweep.executors.base import Executor
from emberlink.trainers.sweep.executors.registry import make
from emberlink.trainers.terminal.signals import Interruption
from emberlink.trainers.tracking import check_installed
from emberlink.trainers.training.setup import check_setup

_INTERVAL = 0.5
"""seconds between two looks at the runs"""
_AGAIN = 60.0
"""seconds after which runs that a cluster did not take are submitted again"""


def sweep(
    arguments: Sequence[str],
    console: Console,
    *,
    dry: bool = False,
    executor: Executor | None = None,
) -> int:
    """Trains and evaluates the runs that are not finished.

    Args:
        arguments: see `combinations`; and `executor=NAME`, `executor.KEY=VALUE`.
        console: shows the progress and a table at the end.
        dry: whether to print the state of each run and do nothing else.
        executor: runs the trainings; replaces the executor of the arguments.

    Returns:
        0; 1 if a run failed; 128 and the number of a signal, such as 130, after it.

    Raises:
        UserError: an argument is wrong, or the output folder cannot be written.
    """
    chosen = [text for text in arguments if text.startswith(("executor=", "executor."))]
    runs = combinations([text for text in arguments if text not in chosen])
    executor = executor or make(chosen)
    output = user_path(runs[0].config.output)
    for note in find_folders(runs, output):
        console.print(f"note: {note}", style="yellow", soft_wrap=True)
    _check([run for run in runs if run.folder is None])
    waiting = [run for run in runs if not run.finished]
    done = len(runs) - len(waiting)
    console.print(f"{len(runs)} runs, of which {done} are finished -> {output}", soft_wrap=True)
    if dry:
        for run in runs:
            console.print(f"  {run.name}: {run.state}", highlight=False, soft_wrap=True)
        return 0
    status = _Sweep(executor, runs, waiting, console).work()
    _print_table(runs, console)
    if status == 0:
        again = f"emberlink compare {shlex.quote(str(output))}"
        console.print(f"compare them with: {again}", soft_wrap=True)
    else:
        console.print("the same command trains what is left")
    return status


def _check(runs: Sequence[Combination]) -> None:
    """Checks that new runs can be trained; those that differ in their seed only, once.

    Raises:
        UserError: one cannot.
    """
    for run in {without_seed(run.config): run for run in reversed(runs)}.values():
        check_installed(run.config.logger)
        try:
            check_setup(run.config)
        except UserError as error:
            raise UserError(f"{run.name}: {error}") from None


class _Sweep:
    """Submits runs, follows them, and cancels them after a signal."""

    def __init__(
        self,
        executor: Executor,
        runs: Sequence[Combination],
        waiting: list[Combination],
        console: Console,
    ):
        self._executor, self._waiting = executor, waiting
        self._running: dict[Combination, Any] = {}
        self._stopped = False
        self._submit_at = 0.0
        self._progress = _RunProgress(console, len(runs), len(runs) - len(waiting))

    def work(self) -> int:
        """Trains all runs and returns the exit status of the sweep."""
        interruption = Interruption(lambda: None)
        failed = 0
        with interruption, self._progress:
            try:
                while self._running or (self._waiting and not self._stopped):
                    if not interruption.received:
                        self._submit()
                    elif not self._stopped:
                        self._stop()
                    failed += self._look()
                    if self._running:
                        time.sleep(_INTERVAL)
            finally:  # after a second signal or an error, the trainings end, too
                self._stop()
                while self._running:
                    self._look()
                    time.sleep(_INTERVAL / 5)
        return interruption.status if interruption.received else int(failed > 0)

    def _submit(self) -> None:
        """Submits as many of the waiting runs as the executor takes.

        Raises:
            UserError: it takes none, and no run is left to wait for.
        """
        workers = self._executor.workers
        room = len(self._waiting) if workers is None else workers - len(self._running)
        if room <= 0 or not self._waiting or time.monotonic() < self._submit_at:
            return
        batch, self._waiting = self._waiting[:room], self._waiting[room:]
        try:
            handles = self._executor.submit([run.task() for run in batch])
        except UserError as error:
            if not self._running:
                raise
            self._waiting = batch + self._waiting
            self._submit_at = time.monotonic() + _AGAIN
            self._progress.say(str(error))
            return
        self._running |= zip(batch, handles, strict=True)

    def _look(self) -> int:
        """Updates the progress and returns the number of runs that have failed since."""
        failed = 0
        for run, handle in list(self._running.items()):
            status = self._executor.poll(handle)
            if status is None:
                self._progress.follow(run)
                continue
            del self._running[run]
            if not run.finished and not self._stopped:
                said = lines_of(run.log)
                run.failed = said[-1].strip() if said else f"exit status {status}"
                failed += 1
            state = "failed" if run.failed else "finished" if run.finished else "stopped"
            self._progress.end(run, state)
        return failed

    def _stop(self) -> None:
        self._stopped = True
        for handle in self._running.values():
            self._executor.cancel(handle)


class _RunProgress(Progress):
    """Shows a bar for all runs and one for each run that has begun, and prints those that end."""

    def __init__(self, console: Console, total: int, done: int):
        super().__init__(
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=20),
            TextColumn("{task.completed:.0f}/{task.total:.0f}"),
            TimeElapsedColumn(),
            console=console,
        )
        self._all = self.add_task("runs", total=total, completed=done)
        self._bars: dict[Combination, TaskID] = {}

    def follow(self, run: Combination) -> None:
        """Shows the episodes of a run as soon as it has one."""
        if episodes := run.episodes:
            if run not in self._bars:
                self._bars[run] = self.add_task(run.name, total=run.config.episodes)
            self.update(self._bars[run], completed=episodes)

    def end(self, run: Combination, state: str) -> None:
        """Prints how a run ended and removes its bar."""
        if run in self._bars:
            self.remove_task(self._bars.pop(run))
        self.advance(self._all)
        self.say(f"{run.name}: {state}")

    def say(self, text: str) -> None:
        """Prints a line above the bars."""
        self.console.print(f"  {text}", highlight=False, soft_wrap=True)


def _print_table(runs: Sequence[Combination], console: Console) -> None:
    """Prints the state and the folder of each run, and the last line of those that failed."""
    table = Table("run", "state", "folder")
    for run in runs:
        state = "failed" if run.failed else run.state
        table.add_row(run.name, state, run.folder.path.name if run.folder else "-")
    console.print(table)
    for run in runs:
        if run.failed:
            console.print(f"{run.name}: {run.failed} (log: {run.log})", soft_wrap=True)


def status(output: Path, console: Console) -> int:
    """Prints the state and the episodes of each run in an output folder.

    Raises:
        UserError: there is none.
    """
    table = Table("run", "state", "episodes")
    for file in sorted(output.glob("*/config.yaml")):
        folder = RunFolder(file.parent)
        run = Combination("", folder.config(device="cpu"), (), folder)
        table.add_row(folder.path.name, _state(run), f"{run.episodes}/{run.config.episodes}")
    if not table.row_count:
        raise UserError(f"{output}: holds no run")
    console.print(table)
    return 0


def _state(run: Combination) -> str:
    try:
        if run.folder and (run.folder.path / "lock").exists():  # also after SIGKILL
            Lock(run.folder.path).release()
    except LockedError:
        return "running"
    return run.state
