"""Shows the progress of a sweep."""

from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from emberlink.trainers.sweep.jobs import Job


class SweepProgress(Progress):
    """Shows a bar for all runs, a bar for each running job, and a line for each finished job.

    Args:
        console: shows the bars.
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
        """Adds a bar for a started job."""
        self._bars[job] = self.add_task(
            job.name, total=job.configs[0].episodes, unit="episodes", coverage=""
        )

    def follow(self, job: Job) -> None:
        """Updates the bar of a job from its metrics.jsonl: number of episodes and last coverage."""
        shown: dict[str, Any] = {}
        for run in list(job.found.values())[:1]:
            try:
                lines = run.folder.lines()
            except (OSError, ValueError):  # the file is being created or truncated
                continue
            if lines:
                shown = {"completed": len(lines), "coverage": f"{lines[-1]['coverage']:.1f} %"}
                if len(lines) == job.configs[0].episodes:
                    shown["coverage"] += ", being evaluated"
        self.update(self._bars[job], **shown)

    def wait(self, job: Job) -> None:
        """Prints a line for a job that waits for another sweep."""
        text = f"  {job.name}: waits, another sweep is training it"
        self.console.print(text, highlight=False, soft_wrap=True)

    def end(self, job: Job, state: str) -> None:
        """Removes a job's bar and prints a line."""
        if job in self._bars:
            self.remove_task(self._bars.pop(job))
        self.advance(self._all, len(job.configs))
        self.console.print(f"  {job.name}: {state}", highlight=False, soft_wrap=True)
