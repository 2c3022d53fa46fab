"""Runs `emberlink world check`: plays scripted policies and tests the conditions of a world."""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple

from rich.console import Console

from emberlink.envs import metrics
from emberlink.envs.scenarios import fires_of
from emberlink.envs.utils.atomic_io import created, new_file
from emberlink.envs.utils.config_files import known
from emberlink.envs.utils.errors import UserError
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.evaluation.evaluate import BLOCK, VALIDATION_START_SEED, play_scripted
from emberlink.trainers.evaluation.scores import means, means_table
from emberlink.trainers.runs import compact_json

Split = Literal["test", "validation"]
Means = Mapping[str, Mapping[str, float]]
"""policy -> measure -> mean over episodes"""
RANDOM, ALONE, ALL, ORACLE = "random_waypoints", "map_greedy_alone", "map_greedy_all", "oracle"
"""the scripted policies on which the conditions depend"""
SHARES = ("coverage", "coverage_auc", "base_coverage", "base_coverage_auc")
"""measures in % to be maximised: the possible headlines of a calibrated world"""
MOST_AT_RANDOM = 50.0
"""% of the oracle's headline; random waypoints may reach at most this much"""
LEAST_GAIN = 10.0
"""%; merging all maps has to raise the headline of merging none by at least this much"""
LEAST_AHEAD = 15.0
"""%; the oracle has to exceed the best policy that does not know the fire by at least this much"""
_METHOD = "independent"  # any method; scripted policies do not depend on it


class Condition(NamedTuple):
    """A bound on the ratio of the headlines of two policies."""

    policies: str
    ratio: float
    """headline of the first, in % of the second's"""
    bound: str
    passes: bool


def conditions(means: Means, headline: str) -> list[Condition]:
    """Returns the conditions of a world.

    Of the policies that know the fire (`oracle…`), that merge all maps (`…_all`) or none
    (`…_alone`), the best one counts; in a world with a base, the best one that reports to it.

    Args:
        means: the measures of at least the four needed policies.
        headline: the world's headline measure, in %.
    """

    def best(belongs: Callable[[str], bool]) -> str:
        return max(filter(belongs, sorted(means)), key=lambda policy: means[policy][headline])

    def condition(one: str, other: str, least: float = 0.0, most: float = math.inf) -> Condition:
        ratio = 100 * means[one][headline] / max(means[other][headline], 1e-9)
        bound = f"at least {least:g}" if least else f"at most {most:g}"
        name = f"{headline} of {one} / {other}"
        return Condition(name, ratio, bound, passes=least <= ratio <= most)

    oracle = best(lambda policy: policy.startswith(ORACLE))
    merged = best(lambda policy: policy.endswith("_all"))
    none = best(lambda policy: policy.endswith("_alone"))
    others = best(lambda policy: not policy.startswith(ORACLE))
    return [
        condition(RANDOM, oracle, most=MOST_AT_RANDOM),
        condition(merged, none, least=100 + LEAST_GAIN),
        condition(oracle, others, least=100 + LEAST_AHEAD),
    ]


def world_config(overrides: Sequence[str]) -> RunConfig:
    """Returns the configuration of a world: `world=NAME` and other `key=value`.

    Raises:
        UserError: a key or value is wrong, the headline is not a share, or the world does not
            evaluate all needed policies.
    """
    config = resolve(_METHOD, overrides)
    headline = config.evaluation.headline
    if headline not in SHARES:
        raise UserError(
            f"world {config.world}: evaluation.headline={headline} is not a share in %; "
            f"known: {', '.join(SHARES)}"
        )
    policies = config.evaluation.scripted
    if lacking := [name for name in (RANDOM, ALONE, ALL, ORACLE) if name not in policies]:
        raise UserError(f"world {config.world}: evaluation.scripted lacks {', '.join(lacking)}")
    return config


def check(
    arguments: Sequence[str],
    console: Console,
    *,
    fires: int,
    split: Split = "test",
    output: Path | None = None,
) -> int:
    """Plays the scripted policies of worlds and tests their conditions.

    `arguments` are names of worlds (`suite` if there are none) and `key=value`. Returns 0 if all
    worlds satisfy all conditions, else 1; `output` is a new .json file for all numbers.
    """
    if output is not None:
        new_file(output, [".json"])
    overrides = [text for text in arguments if "=" in text]
    if any(text.startswith("world=") for text in overrides):
        raise UserError("world=NAME: the worlds are given without a key here")
    names = [text for text in arguments if text not in overrides] or suite(console)
    configs = [world_config([f"world={name}", *overrides]) for name in dict.fromkeys(names)]
    of_validation = {"start_seed": VALIDATION_START_SEED, "block": min(fires, BLOCK)}
    seeds = of_validation if split == "validation" else {}
    record = {}
    for config in configs:
        say = partial(console.print, f"  {config.world} is played by", style="dim")
        arrival = fires_of(config.fire).fires(split, fires, config.env.grid, config.env.horizon)
        measured = {
            policy: means(play_scripted(config, policy, arrival, report=say, **seeds))
            for policy in config.evaluation.scripted
        }
        headline = config.evaluation.headline
        found = conditions(measured, headline)
        title = f"world {config.world}: means of {fires} {split} fires"
        order = sorted(metrics.names(config.env), key=lambda name: name != headline)
        console.print(means_table(title, measured.items(), order))
        for condition in found:
            verdict, style = ("pass", "") if condition.passes else ("FAIL", "red")
            told = f"{condition.policies}: {condition.ratio:.1f} %; {condition.bound}"
            console.print(f"{verdict}: {told}", style=style, soft_wrap=True)
        console.print()
        record[config.world] = {
            **{"fires": fires, "split": split, "headline": headline},
            "passes": all(condition.passes for condition in found),
            "conditions": [condition._asdict() for condition in found],
            "means": measured,
        }
    if output is not None:
        with created(output) as file:
            file.write_text(compact_json.dumps(record) + "\n", encoding="utf-8")
    passing = sum(world["passes"] for world in record.values())
    console.print(f"{passing} of {len(record)} worlds pass")
    return int(passing < len(record))


def suite(console: Console) -> list[str]:
    """Returns the worlds that evaluate all needed policies; prints why others are left out."""
    names = []
    for name in known("world"):
        try:
            world_config([f"world={name}"])
            names.append(name)
        except UserError as error:
            console.print(f"note: {name} is left out: {error}", soft_wrap=True)
    return names
