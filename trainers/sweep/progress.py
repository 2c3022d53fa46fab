"""Shows the progress of a sweep from the files of its runs."""

from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Column

from emberlink.trainers.runs.run_folder import RunFolder
from emberlink.trainers.sweep.jobs import Job

_WITH_BARS = 100
"""columns of a terminal that has room for bars beside the names of runs"""


class SweepProgress(Progress):
    """Shows a bar for all runs, a bar for each running job, and a line for each finished job.

    Args:
        console: shows the bars.
        total: number of runs in the sweep.
        done: number of runs that were finished before.
    """

    def __init__(self, console: Console, total: int, done: int):
        bars: list[ProgressColumn] = [BarColumn(bar_width=20)]
        super().__init__(
            # Long names are wrapped; numbers and times keep their width.
            TextColumn("{task.description}", markup=False, table_column=Column(ratio=1)),
            *(bars if console.width >= _WITH_BARS else []),
            TextColumn("{task.completed:.0f}/{task.total:.0f} {task.fields[unit]}", markup=False),
            TextColumn("{task.fields[coverage]}", markup=False),
            TimeElapsedColumn(),
            console=console,
            expand=True,
        )
        self._all = self.add_task("all", total=total, completed=done, unit="runs", coverage="")
        self._bars: dict[Job, TaskID] = {}
        self._sizes: dict[Job, int] = {}

    def begin(self, job: Job) -> None:
        """Adds a bar for a job that has begun to train, unless there is one."""
        if job not in self._bars:
            self._bars[job] = self.add_task(
                job.name, total=job.configs[0].episodes, unit="episodes", coverage=""
            )

    def follow(self, job: Job) -> None:
        """Updates the bar of a job from its metrics.jsonl: number of episodes and last coverage."""
        for run in list(job.found.values())[:1]:
            size = _size(run.folder)
            if size == self._sizes.get(job, 0):
                continue
            self._sizes[job] = size
            self.begin(job)
            self.update(self._bars[job], **_shown(run.folder, job.configs[0].episodes))

    def wait(self, job: Job) -> None:
        """Prints a line for a job that waits for another sweep."""
        self.say(job, "waits, another sweep is training it")

    def say(self, job: Job, text: str) -> None:
        """Prints a line about a job."""
        self.console.print(f"  {job.name}: {text}", highlight=False, soft_wrap=True)

    def end(self, job: Job, state: str, *, again: bool = False) -> None:
        """Removes a job's bar and prints a line.

        Args:
            job: the job.
            state: how it ended.
            again: whether it is to be run again, and is not counted.
        """
        if job in self._bars:
            self.remove_task(self._bars.pop(job))
        self._sizes.pop(job, None)
        if not again:
            self.advance(self._all, len(job.configs))
        self.say(job, state)


def _size(run: RunFolder) -> int:
    try:
        return (run.path / "metrics.jsonl").stat().st_size
    except OSError:
        return 0


def _shown(run: RunFolder, episodes: int) -> dict[str, Any]:
    """Returns the number of episodes and the last coverage of a run."""
    try:
        lines = run.lines()
    except (OSError, ValueError):  # the file is being created or truncated
        return {}
    if not lines:
        return {}
    known = lines[-1].get("coverage")
    parts = [] if known is None else [f"{known:.1f} %"]
    parts += ["evaluation"] if len(lines) == episodes else []
    return {"completed": len(lines), "coverage": ", ".join(parts)}
