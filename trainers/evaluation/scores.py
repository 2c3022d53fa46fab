"""Defines the results of an evaluation, their means, and the table that is printed."""

from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.terminal.console import plain_table

CURVES = {
    "mean_reward": "mean reward",
    "coverage": "coverage, %",
    "tracking_first": "first UAV on fire, step",
    "tracking_last": "last UAV on fire, step",
    "boundary_exits": "boundary exits per UAV",
    "fire_losses": "fire losses per UAV",
}
"""measure -> axis label, in the order of the paper's figures 5 to 9"""

DIGITS = {"mean_reward": 3, "boundary_exits": 2, "fire_losses": 2}
"""digits after the decimal point in tables; 1 for other measures"""

LEARNED = "learned"
"""name of the learned policy in results"""

Measured = dict[str, list[float]]
"""measure -> one number per episode"""

Results = dict[str, dict[str, Measured]]
"""fire -> policy -> measure -> one number per episode"""


def means(measured: Mapping[str, list[float]]) -> dict[str, float]:
    """Returns the mean over episodes of each measure."""
    return {name: float(np.mean(values)) for name, values in measured.items()}


def validated(line: Mapping[str, float], measure: str) -> float | None:
    """Returns the mean of a measure over the validation fires in a line, if it has any."""
    values = [value for name, value in line.items() if name.endswith(f"/{measure}")]
    return sum(values) / len(values) if values else None


def learned_means(results: Results) -> dict[str, float]:
    """Returns "test/fire/measure" -> mean over episodes of the learned policy."""
    return {
        f"test/{fire}/{name}": value
        for fire, by_policy in results.items()
        for name, value in means(by_policy[LEARNED]).items()
    }


def reporter(console: Console) -> Callable[[str, str], None]:
    """Returns a function that prints which policy flies over which fires."""
    return lambda fire, policy: console.print(
        f"  {policy} on the test fires of {fire}", style="dim", soft_wrap=True
    )


def print_results(console: Console, results: Results, config: RunConfig, policy: str = "") -> None:
    """Prints means over episodes: a table per fire, a row per policy, a column per measure.

    `policy` is the name of the learned policy; its method if empty.
    """
    called = policy or config.method
    for fire, by_policy in results.items():
        measured = by_policy[LEARNED]
        episodes = len(measured["coverage"])
        settings = f"{episodes} episodes, mean; setup {config.setup}, world {config.world}"
        rows = [(called if p == LEARNED else p, means(m)) for p, m in by_policy.items()]
        title = f"test fires: {fire} ({settings})"
        console.print(means_table(title, rows, [*measured], bold=called))


def means_table(
    title: str,
    rows: Iterable[tuple[str, Mapping[str, float]]],
    measures: Sequence[str],
    bold: str = "",
) -> Table:
    """Returns a table with a row per policy and its means, and a column per measure."""
    table = plain_table(title=Text(title))
    table.add_column()
    for name in measures:  # one word per line, so that the table fits 80 columns
        table.add_column(name.replace("_", "\n"), justify="right")
    for policy, mean in rows:
        numbers = [f"{mean[name]:.{DIGITS.get(name, 1)}f}" for name in measures]
        table.add_row(policy, *numbers, style="bold" if policy == bold else None)
    return table
