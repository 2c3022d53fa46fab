"""Shows the progress of a training: a line per episode and, on a terminal, a bar."""

import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from datetime import timedelta
from typing import Any, Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

BETWEEN_LINES = 60.0
"""seconds between lines about the progress within an episode, without a bar"""
FIRST_LINE = 10.0
"""seconds before the first of these lines"""
_PERCENT = ("coverage", "coverage_auc", "base_coverage")
"""measures in %"""
_BETWEEN_REFRESHES = 0.2
"""seconds between updates of the bar"""


class TimeLeft:
    """Estimates the speed and the remaining time of a training.

    Steps before the first update are much faster than later ones. So the remaining time is
    estimated from the mean of the steps since then.

    Args:
        steps: number of steps of the whole training.
        learns: whether there will be any updates.
        span: least number of steps over which the speed is averaged. Learners that make their
            updates at the end of an episode need a whole one.
    """

    ENOUGH = 3.0
    """seconds with updates before the first estimate"""
    WINDOW = 30.0
    """least number of seconds over which the speed is averaged"""

    def __init__(self, steps: int, *, learns: bool = True, span: int = 0):
        self._steps, self._learns, self._span = steps, learns, span
        self._start: tuple[float, int] | None = None
        self._recent: deque[tuple[float, int]] = deque()

    def add(self, now: float, step: int, updates: int) -> None:
        """Records the end of a step.

        Args:
            now: time in seconds.
            step: number of the step.
            updates: number of updates so far.
        """
        if self._recent and step < self._recent[-1][1]:  # after a rollback
            self._start = None
            self._recent.clear()
        if self._start is None and (updates > 0 or not self._learns):
            self._start = now, step
        self._recent.append((now, step))
        while len(self._recent) > 2 and self._covers(*self._recent[1], now, step):
            self._recent.popleft()

    def _covers(self, before: float, first: int, now: float, last: int) -> bool:
        """Returns whether the speed can be averaged from an earlier step and time."""
        return now - before > self.WINDOW and last - first >= self._span

    @property
    def speed(self) -> float | None:
        """Steps per second in the last `WINDOW` seconds and `span` steps; None before two steps."""
        if not self._recent:
            return None
        (before, first), (now, last) = self._recent[0], self._recent[-1]
        return (last - first) / (now - before) if now > before else None

    @property
    def seconds(self) -> float | None:
        """Remaining seconds; None if there are too few steps with updates."""
        if self._start is None or not self._recent:
            return None
        (before, first), (now, last) = self._start, self._recent[-1]
        if last == first or now - before < self.ENOUGH:
            return None
        return (self._steps - last) * (now - before) / (last - first)


class TrainingProgress:
    """Shows the progress of a training.

    Prints a line with measures for each episode and each evaluation. A terminal also shows a bar.
    Without a terminal, a line per minute shows the progress within a long episode.

    Args:
        console: prints the lines and shows the bar.
        steps: number of steps of the whole training.
        episodes: number of episodes of the whole training.
        step: number of steps done before.
        learns: whether there will be any updates.
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
        learns: bool = True,
        headline: str = "coverage",
        clock: Callable[[], float] = time.monotonic,
    ):
        self._console, self._clock, self._headline = console, clock, headline
        self._steps, self._episodes, self._learns = steps, episodes, learns
        self._left = TimeLeft(steps, learns=learns, span=steps // episodes)
        self._left.add(clock(), step, 0)
        self._next_line = clock() + FIRST_LINE
        self._next_refresh = 0.0
        self._bar: Progress | None = None
        if console.is_terminal:
            self._bar = Progress(
                TextColumn("{task.description}"),
                BarColumn(bar_width=None),
                console=console,
                auto_refresh=False,
                redirect_stdout=False,
                expand=True,
            )
            self._task = self._bar.add_task("", total=steps, completed=step)

    def __enter__(self) -> Self:
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def step(self, step: int, episode: int, updates: int) -> None:
        """Updates the progress at the end of a step.

        Args:
            step: number of the step.
            episode: number of finished episodes.
            updates: number of updates so far.
        """
        now = self._clock()
        self._left.add(now, step, updates)
        if self._bar is not None:
            if now >= self._next_refresh or step == self._steps:
                self._next_refresh = now + _BETWEEN_REFRESHES
                text = f"step {step}/{self._steps} {self._pace(updates)}"
                self._bar.update(self._task, completed=step, description=text)
                self._bar.refresh()
        elif now >= self._next_line:
            running = min(episode + 1, self._episodes)
            self.note(
                f"episode {running}/{self._episodes}, step {step}/{self._steps}: "
                f"{self._pace(updates)}"
            )

    def episode(self, episode: int, lines: Sequence[Mapping[str, Any]]) -> None:
        """Prints the measures of an episode and of the evaluation after it, if any.

        Args:
            episode: number of the episode.
            lines: the line of metrics.jsonl of each seed; their means are printed.
        """
        means = {name: sum(line[name] for line in lines) / len(lines) for name in lines[0]}
        self.note(
            f"episode {episode}/{self._episodes}: coverage {means['coverage']:.1f} %, "
            f"mean reward {means['mean_reward']:.2f}, {self._pace(means['updates'])}"
        )
        end, unit = f"/{self._headline}", " %" if self._headline in _PERCENT else ""
        evaluated = [name.removesuffix(end) for name in means if name.endswith(end)]
        if evaluated:
            shown = ", ".join(f"{fire} {means[fire + end]:.1f}{unit}" for fire in evaluated)
            self.note(f"  without noise, on validation fires: {self._headline} {shown}")

    def note(self, text: str, style: str = "") -> None:
        """Prints a line above the bar."""
        self._console.print(text, style=style, soft_wrap=True)
        self._next_line = self._clock() + BETWEEN_LINES

    def _pace(self, updates: float) -> str:
        """Returns the speed and the remaining time as text."""
        speed, seconds = self._left.speed, self._left.seconds
        parts = [] if speed is None else [f"{speed:.{0 if speed >= 100 else 1}f} steps/s"]
        if seconds is not None:
            parts.append(f"{timedelta(seconds=round(seconds))} left")
        elif self._learns and updates == 0:
            parts.append("no updates yet")
        return ", ".join(parts)
