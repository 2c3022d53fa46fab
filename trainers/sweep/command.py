"""Runs `emberlink sweep`: trains every combination that is not finished."""

import shlex
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from rich import progress
from rich.console import Console
from rich.table import Table

from emberlink.envs.utils.atomic_io import user_path
from emberlink.envs.utils.errors import UserError
from emberlink.trainers.sweep.combinations import Combination, combinations, find_folders, identity
from emberlink.trainers.sweep.executors.base import Executor, make
from emberlink.trainers.terminal.console import plain_table
from emberlink.trainers.terminal.signals import Interruption
from emberlink.trainers.training.setup import check_setup


def sweep(
    arguments: Sequence[str],
    console: Console,
    *,
    dry_run: bool = False,
    executor: Executor | None = None,
) -> int:
    """Trains and evaluates the runs that are not finished, or only prints their states.

    `arguments` as for `combinations`, and also `executor=NAME` and `executor.KEY=VALUE`, which
    `executor` replaces. Returns 1 if a run failed, 128 and the number of a signal after it, else 0.
    """
    chosen = [text for text in arguments if text.startswith(("executor=", "executor."))]
    runs = combinations([text for text in arguments if text not in chosen])
    executor = executor or make(chosen)
    output = user_path(runs[0].config.output)
    find_folders(runs, output)
    _check([run for run in runs if run.folder is None])
    if dry_run:
        console.print(_table(runs))
        return 0
    done = sum(run.finished for run in runs)
    console.print(f"{len(runs)} runs, of which {done} are finished -> {output}", soft_wrap=True)
    status = _Trainings(executor, runs, console).work()
    console.print(_table(runs))
    for run in runs:
        if run.failed:
            console.print(f"{run.name}: {run.failed} (log: {run.log})", soft_wrap=True)
    then = f"compare them with: emberlink compare {shlex.quote(str(output))}"
    console.print("the same command trains what is left" if status else then, soft_wrap=True)
    return status


def _table(runs: Sequence[Combination]) -> Table:
    table = plain_table("run", "state", "episodes", "folder")
    for run in runs:
        place = run.folder.path.name if run.folder else "-"
        table.add_row(run.name, run.state, f"{run.episodes}/{run.config.episodes}", place)
    return table


def _check(runs: Sequence[Combination]) -> None:
    """Checks that new runs can be trained; of several that differ in the seed only, one."""
    for run in {identity(replace(run.config, seed=0)): run for run in reversed(runs)}.values():
        try:
            check_setup(run.config)
        except UserError as error:
            raise UserError(f"{run.name}: {error}") from None


class _Trainings:
    """Submits runs, follows them with a bar for all episodes, and cancels them after a signal."""

    def __init__(self, executor: Executor, runs: Sequence[Combination], console: Console):
        self._executor, self._runs = executor, runs
        self._waiting = [run for run in runs if not run.finished]
        self._running: dict[Combination, Any] = {}
        self._most = executor.workers or len(runs)
        self._episodes = {run: run.episodes for run in runs}
        columns = "{task.description}", progress.BarColumn(), progress.MofNCompleteColumn()
        self._bars = progress.Progress(*columns, progress.TimeRemainingColumn(), console=console)

    def work(self) -> int:
        """Trains all runs and returns the exit status of the sweep."""
        total = sum(run.config.episodes for run in self._runs)
        with Interruption(lambda: None) as interruption, self._bars:
            bar = self._bars.add_task("episodes", total=total)
            try:
                while (self._running or self._waiting) and not interruption.received:
                    self._submit()
                    self._look()
                    self._bars.update(bar, completed=sum(self._episodes.values()))
            finally:  # the trainings end also after a signal or an error
                for handle in self._running.values():
                    self._executor.cancel(handle)
                while self._running:
                    self._look(stopped=True)
        failed = any(run.failed for run in self._runs)
        return interruption.status if interruption.received else int(failed)

    def _submit(self) -> None:
        """Submits as many of the waiting runs as the executor takes."""
        batch = self._waiting[: max(self._most - len(self._running), 0)]
        if not batch:
            return
        try:
            handles = self._executor.submit([run.task() for run in batch])
        except UserError as error:
            if not self._running:
                raise
            self._most = len(self._running)  # the cluster takes no more at a time
            self._say(str(error))
            return
        del self._waiting[: len(batch)]
        self._running |= zip(batch, handles, strict=True)

    def _look(self, stopped: bool = False) -> None:
        """Counts the episodes and removes the runs that have ended, then waits."""
        for run, handle in list(self._running.items()):
            self._episodes[run] = run.episodes
            status = self._executor.poll(handle)
            if status is None:
                continue
            del self._running[run]
            if not run.finished and not stopped:
                said = run.log.read_text(errors="replace").split("\n") if run.log.exists() else []
                run.failed = next(filter(str.strip, said[::-1]), f"exit status {status}").strip()
            state = "failed" if run.failed else "finished" if run.finished else "stopped"
            self._say(f"{run.name}: {state}")
        if self._running:
            time.sleep(0.5)

    def _say(self, text: str) -> None:
        """Prints a line above the bar."""
        self._bars.console.print(f"  {text}", highlight=False, soft_wrap=True)
