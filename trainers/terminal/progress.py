"""Shows the progress of a training: a line per episode and, on a terminal, a bar."""

from datetime import timedelta
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn


class TrainingProgress(Progress):
    """Prints a line for each episode and each evaluation; a terminal also shows a bar.

    `steps` counts the whole training; `step` is where it begins.
    """

    def __init__(self, console: Console, headline: str, steps: int, step: int):
        super().__init__(
            TextColumn("step {task.completed}/{task.total}"),
            BarColumn(bar_width=None),
            TimeRemainingColumn(),
            console=console,
            redirect_stdout=False,
            expand=True,
            speed_estimate_period=120,
            disable=not console.is_terminal,
        )
        self._headline = headline
        self.add_task("", total=steps, completed=step)

    def report(self, now: Any) -> None:
        """Moves the bar to a `Progress`; at the end of an episode, prints its measures."""
        (task,), line = self.tasks, now.line
        self.update(task.id, completed=now.step)
        if not line or now.step % (now.steps // now.episodes):
            return
        pace = f", {speed:.0f} steps/s" if (speed := task.finished_speed or task.speed) else ""
        seconds = 0 if self.console.is_terminal else task.time_remaining  # the bar shows it
        left = f", {timedelta(seconds=seconds)} left" if seconds else ""
        text = (
            f"episode {now.episode}/{now.episodes}: coverage {line['coverage']:.1f} %, "
            f"mean reward {line['mean_reward']:.2f}{pace}{left}"
        )
        fires = [name.partition("/")[0] for name in line if name.endswith(f"/{self._headline}")]
        if fires:
            shown = ", ".join(f"{fire} {line[f'{fire}/{self._headline}']:.1f}" for fire in fires)
            text += f"\n  without noise, on validation fires: {self._headline} {shown}"
        self.console.print(text, soft_wrap=True)
