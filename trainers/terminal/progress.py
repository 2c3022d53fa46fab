"""Shows the progress of a training: a line per episode and, on a terminal, a bar."""

import time
from collections.abc import Callable, Mapping
from datetime import timedelta
from typing import Any, Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

_BETWEEN_REFRESHES = 0.2
"""seconds between updates of the bar"""


class TrainingProgress:
    """Prints a line for each episode and each evaluation; a terminal also shows a bar.

    Args:
        console: prints the lines and shows the bar.
        steps: number of steps of the whole training.
        episodes: number of episodes of the whole training.
        step: number of steps done before.
        headline: the measure of evaluations that is printed.
        clock: returns the time in seconds.
    """

    def __init__(
        self,
        console: Console,
        *,
        steps: int,
        episodes: int,
        step: int = 0,
        headline: str = "coverage",
        clock: Callable[[], float] = time.monotonic,
    ):
        self._console, self._clock, self._headline = console, clock, headline
        self._steps, self._episodes = steps, episodes
        self._next_refresh = 0.0
        self._bar = Progress(
            TextColumn("step {task.completed}/{task.total}"),
            BarColumn(bar_width=None),
            TimeRemainingColumn(),
            console=console,
            auto_refresh=False,
            redirect_stdout=False,
            expand=True,
            get_time=clock,
            speed_estimate_period=120,
            disable=not console.is_terminal,
        )
        self._task = self._bar.add_task("", total=steps, completed=step)

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def step(self, step: int) -> None:
        """Updates the bar at the end of a step."""
        now = self._clock()
        if now >= self._next_refresh or step == self._steps:
            self._next_refresh = now + _BETWEEN_REFRESHES
            self._bar.update(self._task, completed=step)
            self._bar.refresh()

    def episode(self, episode: int, line: Mapping[str, Any]) -> None:
        """Prints the measures of an episode and of the evaluation after it, if any.

        Args:
            episode: number of the episode.
            line: the line of metrics.jsonl.
        """
        task = self._bar.tasks[0]
        pace = f", {speed:.0f} steps/s" if (speed := task.finished_speed or task.speed) else ""
        seconds = 0 if self._console.is_terminal else task.time_remaining  # the bar shows it
        left = f", {timedelta(seconds=seconds)} left" if seconds else ""
        self.note(
            f"episode {episode}/{self._episodes}: coverage {line['coverage']:.1f} %, "
            f"mean reward {line['mean_reward']:.2f}{pace}{left}"
        )
        end = f"/{self._headline}"
        evaluated = [name.removesuffix(end) for name in line if name.endswith(end)]
        if evaluated:
            shown = ", ".join(f"{fire} {line[fire + end]:.1f}" for fire in evaluated)
            self.note(f"  without noise, on validation fires: {self._headline} {shown}")

    def note(self, text: str, style: str = "") -> None:
        """Prints a line above the bar."""
        self._console.print(text, style=style, soft_wrap=True)
