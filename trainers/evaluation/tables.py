"""Prints the table of an evaluation."""

from collections.abc import Mapping, Sequence

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from emberlink.envs import metrics
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.evaluation.results import LEARNED, Results, means
from emberlink.trainers.terminal import print_table


def print_results(
    console: Console, results: Sequence[Results], configs: Sequence[RunConfig]
) -> None:
    """Prints means over episodes: a table per fire, a row per policy, a column per measure.

    With several seeds, there is a row for their mean, one for each seed, and one for the standard
    deviation between seeds. The results of scripted policies are those of the first seed.

    Args:
        console: prints the tables.
        results: results of each seed.
        configs: configuration of each seed.
    """
    method, setup = configs[0].method, configs[0].setup
    for fire, by_policy in results[0].items():
        episodes = len(by_policy[LEARNED]["coverage"])
        table = Table(title=Text(f"test fires: {fire} ({episodes} episodes, mean; setup {setup})"))
        table.add_column()
        for name in metrics.NAMES:
            # One word per line, so that the table fits 80 columns.
            table.add_column(name.replace("_", "\n"), justify="right")
        learned = [means(of_seed[fire][LEARNED]) for of_seed in results]
        if len(results) == 1:
            _add_row(table, method, learned[0], "bold")
        else:
            _add_seeds(table, method, learned, [config.seed for config in configs])
        for policy, measured in by_policy.items():
            if policy != LEARNED:
                _add_row(table, policy, means(measured))
        print_table(console, table)


def _add_seeds(
    table: Table, method: str, learned: Sequence[Mapping[str, float]], seeds: Sequence[int]
) -> None:
    """Adds the mean over the seeds, a row per seed, and the standard deviation."""
    values = {name: [of_seed[name] for of_seed in learned] for name in metrics.NAMES}
    _add_row(table, method, {name: float(np.mean(of)) for name, of in values.items()}, "bold")
    for seed, of_seed in zip(seeds, learned, strict=True):
        _add_row(table, f"  seed {seed}", of_seed)
    deviation = {name: float(np.std(of, ddof=1)) for name, of in values.items()}
    _add_row(table, "  std. dev.", deviation)


def _add_row(table: Table, name: str, measured: Mapping[str, float], style: str = "") -> None:
    table.add_row(
        name, *(_number(measure, measured[measure]) for measure in metrics.NAMES), style=style
    )


def _number(measure: str, value: float) -> str:
    """Formats a value with one decimal place, but a mean reward with at least four digits."""
    digits = max(1, 4 - len(str(int(abs(value))))) if measure == "mean_reward" else 1
    return f"{value:.{digits}f}"
