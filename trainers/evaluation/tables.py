"""Prints the table of an evaluation."""

from collections.abc import Sequence

from rich.console import Console
from rich.table import Table
from rich.text import Text

from emberlink.envs import metrics
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.evaluation.results import LEARNED, Measured, Results, means
from emberlink.trainers.terminal.table import print_table


def print_results(console: Console, results: Results, config: RunConfig) -> None:
    """Prints means over episodes: a row per policy, a column per measure.

    There is a table per fire, and a second one if the world has measures besides the paper's.
    """
    for fire, by_policy in results.items():
        others = [name for name in by_policy[LEARNED] if name not in metrics.NAMES]
        for measures in filter(None, (metrics.NAMES, others)):
            print_table(console, _table(by_policy, config, fire, measures))


def _table(
    by_policy: dict[str, Measured], config: RunConfig, fire: str, measures: Sequence[str]
) -> Table:
    """Returns a table of some measures on one kind of fire."""
    episodes = len(by_policy[LEARNED]["coverage"])
    settings = f"{episodes} episodes, mean; setup {config.setup}, world {config.world}"
    table = Table(title=Text(f"test fires: {fire} ({settings})"))
    table.add_column()
    for name in measures:
        # One word per line, so that the table fits 80 columns.
        table.add_column(name.replace("_", "\n"), justify="right")
    for policy, measured in by_policy.items():
        mean = means(measured)
        numbers = [_number(name, mean[name]) for name in measures]
        if policy == LEARNED:
            table.add_row(config.method, *numbers, style="bold")
        else:
            table.add_row(policy, *numbers)
    return table


def _number(measure: str, value: float) -> str:
    """Formats a value with one decimal place, but a mean reward with at least four digits."""
    digits = max(1, 4 - len(str(int(abs(value))))) if measure == "mean_reward" else 1
    return f"{value:.{digits}f}"
