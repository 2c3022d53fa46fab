"""The table of an evaluation."""

from collections.abc import Mapping, Sequence

import numpy as np
from rich.console import Console

from emberlink.envs import metrics
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.terminal import Column, Row, Table, print_table

from .results import LEARNED, Results, means


def print_results(
    console: Console, results: Sequence[Results], configs: Sequence[RunConfig]
) -> None:
    """Prints means over episodes: a table per fire, a row per policy, a column per measure.

    With several seeds there is a row per seed, and one each for the mean over the seeds and the
    standard deviation between them. The scripted policies' rows are those of the first seed.

    Args:
        console: where the table is printed.
        results: of each seed.
        configs: of each seed.
    """
    method, setup = configs[0].method, configs[0].setup
    for fire, by_policy in results[0].items():
        episodes = len(by_policy[LEARNED]["coverage"])
        # One word below the other, so that all measures fit 80 columns.
        columns = [Column(name.replace("_", "\n")) for name in metrics.NAMES]
        table = Table(
            f"test fires: {fire} ({episodes} episodes, mean; setup {setup})",
            [Column("", right=False), *columns],
        )
        learned = [means(one[fire][LEARNED]) for one in results]
        if len(results) == 1:
            table.rows.append(_row(method, learned[0], "bold"))
        else:
            table.rows += _rows_of_seeds(method, learned, [config.seed for config in configs])
        for policy, measured in by_policy.items():
            if policy != LEARNED:
                table.rows.append(_row(policy, means(measured)))
        print_table(console, table)


def _rows_of_seeds(
    method: str, learned: Sequence[Mapping[str, float]], seeds: Sequence[int]
) -> list[Row]:
    """Returns a row per seed, their mean and their standard deviation."""
    table = {name: [one[name] for one in learned] for name in metrics.NAMES}
    mean = {name: float(np.mean(values)) for name, values in table.items()}
    deviation = {name: float(np.std(values, ddof=1)) for name, values in table.items()}
    return [
        _row(method, mean, "bold"),
        *(_row(f"  seed {seed}", one) for seed, one in zip(seeds, learned, strict=True)),
        _row("  std. dev.", deviation),
    ]


def _row(name: str, measured: Mapping[str, float], style: str = "") -> Row:
    return Row([name, *(_number(one, measured[one]) for one in metrics.NAMES)], style)


def _number(measure: str, value: float) -> str:
    """Returns one decimal; of a mean reward, which may be small, as many as make four digits."""
    digits = max(1, 4 - len(str(int(abs(value))))) if measure == "mean_reward" else 1
    return f"{value:.{digits}f}"
