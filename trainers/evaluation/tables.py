"""Prints the table of an evaluation."""

from collections.abc import Mapping, Sequence

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from emberlink.envs import metrics
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.evaluation.results import LEARNED, Results, means
from emberlink.trainers.terminal.table import print_table


def print_results(
    console: Console, results: Sequence[Results], configs: Sequence[RunConfig]
) -> None:
    """Prints means over episodes: a row per policy, a column per measure.

    There is a table per fire, and a second one if the world has measures besides the paper's.

    With several seeds, there is a row for their mean, one for each seed, and one for the standard
    deviation between seeds. The results of scripted policies are those of the first seed.

    Args:
        console: prints the tables.
        results: results of each seed.
        configs: configuration of each seed.
    """
    for fire in results[0]:
        print_table(console, _table(results, configs, fire, metrics.NAMES))
        if others := [name for name in results[0][fire][LEARNED] if name not in metrics.NAMES]:
            print_table(console, _table(results, configs, fire, others))


def _table(
    results: Sequence[Results], configs: Sequence[RunConfig], fire: str, measures: Sequence[str]
) -> Table:
    """Returns a table of some measures on one kind of fire."""
    by_policy, config = results[0][fire], configs[0]
    episodes = len(by_policy[LEARNED]["coverage"])
    settings = f"{episodes} episodes, mean; setup {config.setup}, world {config.world}"
    table = Table(title=Text(f"test fires: {fire} ({settings})"))
    table.add_column()
    for name in measures:
        # One word per line, so that the table fits 80 columns.
        table.add_column(name.replace("_", "\n"), justify="right")
    learned = [means(of_seed[fire][LEARNED]) for of_seed in results]
    if len(results) == 1:
        _add_row(table, config.method, learned[0], measures, "bold")
    else:
        _add_seeds(table, config.method, learned, measures, [c.seed for c in configs])
    for policy, measured in by_policy.items():
        if policy != LEARNED:
            _add_row(table, policy, means(measured), measures)
    return table


def _add_seeds(
    table: Table,
    method: str,
    learned: Sequence[Mapping[str, float]],
    measures: Sequence[str],
    seeds: Sequence[int],
) -> None:
    """Adds the mean over the seeds, a row per seed, and the standard deviation."""
    values = {name: [of_seed[name] for of_seed in learned] for name in measures}
    overall = {name: float(np.mean(of)) for name, of in values.items()}
    _add_row(table, method, overall, measures, "bold")
    for seed, of_seed in zip(seeds, learned, strict=True):
        _add_row(table, f"  seed {seed}", of_seed, measures)
    deviation = {name: float(np.std(of, ddof=1)) for name, of in values.items()}
    _add_row(table, "  std. dev.", deviation, measures)


def _add_row(
    table: Table,
    name: str,
    measured: Mapping[str, float],
    measures: Sequence[str],
    style: str = "",
) -> None:
    table.add_row(name, *(_number(measure, measured[measure]) for measure in measures), style=style)


def _number(measure: str, value: float) -> str:
    """Formats a value with one decimal place, but a mean reward with at least four digits."""
    digits = max(1, 4 - len(str(int(abs(value))))) if measure == "mean_reward" else 1
    return f"{value:.{digits}f}"
