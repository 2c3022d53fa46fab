"""The one progress display of a sweep."""

from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

if TYPE_CHECKING:
    from .command import Job


class SweepProgress(Progress):
    """A bar for all runs, and one for each that is being trained; a line for each that ends.

    Args:
        console: where it is shown.
        total: runs of the sweep.
        done: how many were finished before.
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
        self._of: dict[int, TaskID] = {}

    def begin(self, job: "Job") -> None:
        """Shows a run that starts or goes on."""
        self._of[id(job)] = self.add_task(
            job.name, total=job.configs[0].episodes, unit="episodes", coverage=""
        )

    def follow(self, job: "Job") -> None:
        """Shows how far a run is: the episodes in its metrics.jsonl, and the last coverage."""
        shown: dict[str, Any] = {}
        for run in job.folders.values():
            try:
                lines = run.lines()
            except (OSError, ValueError):  # it is being cut back, or made
                continue
            if lines:
                shown = {"completed": len(lines), "coverage": f"{lines[-1]['coverage']:.1f} %"}
                if len(lines) == job.configs[0].episodes:
                    shown["coverage"] += ", being evaluated"
                break
        self.update(self._of[id(job)], **shown)

    def end(self, job: "Job", state: str) -> None:
        """Takes a run's bar away and leaves a line."""
        self.remove_task(self._of.pop(id(job)))
        self.advance(self._all)
        self.console.print(f"  {job.name}: {state}", highlight=False, soft_wrap=True)
