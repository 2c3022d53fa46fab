"""The progress display of a sweep."""

from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from emberlink.trainers.sweep.jobs import Job


class SweepProgress(Progress):
    """A bar for all runs and one for each job that is running; a line for each job that ends.

    Args:
        console: where it is shown.
        total: number of runs in the sweep.
        done: number of runs that were finished before.
    """

    def __init__(self, console: Console, total: int, done: int):
        super().__init__(
            TextColumn("{task.description}"),
            BarColumn(bar_width=20),
            TextColumn("{task.completed:.0f}/{task.total:.0f} {task.fields[unit]}"),
            TextColumn("{task.fields[coverage]}"),
            TimeElapsedColumn(),
            console=console,
        )
        self._all = self.add_task("all", total=total, completed=done, unit="runs", coverage="")
        self._bars: dict[Job, TaskID] = {}

    def begin(self, job: Job) -> None:
        """Adds a bar for a job that was started."""
        self._bars[job] = self.add_task(
            job.name, total=job.configs[0].episodes, unit="episodes", coverage=""
        )

    def follow(self, job: Job) -> None:
        """Shows the episodes in a job's metrics.jsonl, and the coverage of the last."""
        shown: dict[str, Any] = {}
        for run in list(job.found.values())[:1]:
            try:
                lines = run.folder.lines()
            except (OSError, ValueError):  # the file is being made, or cut when a run is resumed
                continue
            if lines:
                shown = {"completed": len(lines), "coverage": f"{lines[-1]['coverage']:.1f} %"}
                if len(lines) == job.configs[0].episodes:
                    shown["coverage"] += ", being evaluated"
        self.update(self._bars[job], **shown)

    def wait(self, job: Job) -> None:
        """Leaves a line for a job that waits for another sweep."""
        text = f"  {job.name}: is being trained by another sweep; waits for it"
        self.console.print(text, highlight=False, soft_wrap=True)

    def end(self, job: Job, state: str) -> None:
        """Replaces a job's bar by a line."""
        if job in self._bars:
            self.remove_task(self._bars.pop(job))
        self.advance(self._all, len(job.configs))
        self.console.print(f"  {job.name}: {state}", highlight=False, soft_wrap=True)
