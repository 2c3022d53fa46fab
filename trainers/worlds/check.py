"""Runs `emberlink world check`: measures scripted policies and tests the conditions of a world."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from emberlink.configs import known
from emberlink.envs import metrics
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.publish import new_file, published
from emberlink.policies.scripted.registry import to_play
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.evaluation.results import means
from emberlink.trainers.runs import compact_json
from emberlink.trainers.worlds.conditions import Condition, Means, conditions, missing
from emberlink.trainers.worlds.play import Split, played, world_config


def check(
    arguments: Sequence[str],
    console: Console,
    *,
    fires: int,
    split: Split = "test",
    output: Path | None = None,
) -> int:
    """Plays the scripted policies of worlds and tests their conditions.

    Args:
        arguments: names of worlds (`suite` if there are none), and `key=value`.
        console: prints a table and the conditions of each world.
        fires: number of fires, one episode each.
        split: "test" or "validation".
        output: a new .json file for all numbers.

    Returns:
        0 if all worlds satisfy all conditions, else 1.

    Raises:
        UserError: a world or a key is wrong, or a world lacks a policy or a measure.
    """
    if output is not None:
        new_file(output, [".json"])
    overrides = [text for text in arguments if "=" in text]
    if any(text.partition("=")[0] == "world" for text in overrides):
        raise UserError("world=NAME: the worlds are given without a key here")
    names = [text for text in arguments if text not in overrides] or suite(console)
    configs = [world_config([f"world={name}", *overrides]) for name in dict.fromkeys(names)]
    for config in configs:
        if lacking := missing(config.evaluation.scripted):
            raise UserError(f"world {config.world}: {_lacks(lacking)}")
    record = {}
    for config in configs:
        measured = _measure(config, console, fires, split)
        found = conditions(measured, config.evaluation.headline)
        console.print(_table(config, measured, fires, split))
        for condition in found:
            style = "" if condition.passes else "red"
            console.print(_line(condition), style=style, soft_wrap=True)
        console.print()
        record[config.world] = _record(config, measured, found, fires, split)
    if output is not None:
        with published(output) as partial:
            partial.write_text(compact_json.dumps(record) + "\n", encoding="utf-8")
    passing = [name for name, world in record.items() if world["passes"]]
    console.print(f"{len(passing)} of {len(record)} worlds pass")
    return int(len(passing) < len(record))


def suite(console: Console) -> list[str]:
    """Returns the worlds that evaluate all needed policies; prints why others are left out."""
    names = []
    for name in known("world"):
        try:
            lacking = missing(world_config([f"world={name}"]).evaluation.scripted)
        except UserError as error:
            console.print(f"note: world {name} is left out: {error}", soft_wrap=True)
            continue
        if lacking:
            console.print(f"note: world {name} is left out: {_lacks(lacking)}", soft_wrap=True)
        else:
            names.append(name)
    return names


def _lacks(policies: Sequence[str]) -> str:
    return f"evaluation.scripted lacks {', '.join(policies)}"


def _measure(config: RunConfig, console: Console, fires: int, split: Split) -> Means:
    """Returns the means of the scripted policies of a world."""

    def say(policy: str) -> None:
        console.print(f"  {config.world}: {policy} plays", style="dim")

    return {
        policy: means(played(config, policy, fires=fires, split=split, report=say))
        for policy in to_play(config.evaluation.scripted)
    }


def _table(config: RunConfig, measured: Means, fires: int, split: Split) -> Table:
    """Returns a table with a row per policy and a column per measure, the headline first."""
    table = Table(title=Text(f"world {config.world}: means of {fires} {split} fires"))
    table.add_column()
    order = sorted(metrics.names(config.env), key=lambda name: name != config.evaluation.headline)
    for name in order:
        table.add_column(name.replace("_", "\n"), justify="right")
    for policy, of_policy in measured.items():
        table.add_row(policy, *(f"{of_policy[name]:.1f}" for name in order))
    return table


def _line(condition: Condition) -> str:
    """Returns a condition as a line of text."""
    figures = "; ".join(f"{name} {number:.1f}" for name, number in condition.figures.items())
    kind = "at most" if condition.at_most else "at least"
    one = "one of them " if len(condition.figures) > 1 else ""
    verdict = "pass" if condition.passes else "FAIL"
    return f"{verdict}: {condition.name}: {figures}; {one}{kind} {condition.bound:g}"


def _record(
    config: RunConfig, measured: Means, found: Sequence[Condition], fires: int, split: Split
) -> dict[str, Any]:
    """Returns the numbers of a world for JSON."""
    return {
        "fires": fires,
        "split": split,
        "headline": config.evaluation.headline,
        "passes": all(condition.passes for condition in found),
        "conditions": [
            {
                "policies": condition.name,
                "figures": {name: round(number, 3) for name, number in condition.figures.items()},
                "at_most" if condition.at_most else "at_least": condition.bound,
                "passes": condition.passes,
            }
            for condition in found
        ],
        "means": {
            policy: {name: round(number, 3) for name, number in of_policy.items()}
            for policy, of_policy in measured.items()
        },
    }
