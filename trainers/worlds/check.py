"""Runs `emberlink world check`: plays scripted policies and tests the conditions of a world."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

from rich.console import Console

from emberlink.envs import metrics
from emberlink.envs.scenarios import fires_of
from emberlink.envs.utils.atomic_io import created, new_file
from emberlink.envs.utils.config_files import known
from emberlink.envs.utils.errors import UserError
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.evaluation.evaluate import BLOCK, VALIDATION_START_SEED, play_scripted
from emberlink.trainers.evaluation.scores import Measured, means, means_table
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
    bound: float
    kind: str = "at least"

    @property
    def passes(self) -> bool:
        """Whether the ratio keeps the bound."""
        return self.ratio <= self.bound if self.kind == "at most" else self.ratio >= self.bound

    def __str__(self) -> str:
        verdict = "pass" if self.passes else "FAIL"
        return f"{verdict}: {self.policies}: {self.ratio:.1f} %; {self.kind} {self.bound:g}"


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

    def condition(one: str, other: str, *bound: Any) -> Condition:
        share = 100 * means[one][headline] / max(means[other][headline], 1e-9)
        return Condition(f"{headline} of {one} / {other}", share, *bound)

    oracle = best(lambda policy: policy.startswith(ORACLE))
    merged, none = (
        best(lambda policy, end=end: policy.endswith(end)) for end in ("_all", "_alone")
    )
    return [
        condition(RANDOM, oracle, MOST_AT_RANDOM, "at most"),
        condition(merged, none, 100 + LEAST_GAIN),
        condition(oracle, best(lambda policy: not policy.startswith(ORACLE)), 100 + LEAST_AHEAD),
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


def played(
    config: RunConfig,
    policy: str,
    *,
    fires: int,
    split: Split,
    report: Callable[[str], None] = lambda _: None,
) -> Measured:
    """Returns the measures of a scripted policy, from the cache if they are in it.

    `fires` is the number of test or validation fires, one episode each.
    """
    arrival = fires_of(config.fire).fires(split, fires, config.env.grid, config.env.horizon)
    of_validation = {"start_seed": VALIDATION_START_SEED, "block": min(fires, BLOCK)}
    seeds = of_validation if split == "validation" else {}
    return play_scripted(config, policy, arrival, **seeds, report=report)


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
    record = {}
    for config in configs:
        say = partial(console.print, f"  {config.world} is played by", style="dim")
        measured = {
            policy: means(played(config, policy, fires=fires, split=split, report=say))
            for policy in config.evaluation.scripted
        }
        headline = config.evaluation.headline
        found = conditions(measured, headline)
        title = f"world {config.world}: means of {fires} {split} fires"
        order = sorted(metrics.names(config.env), key=lambda name: name != headline)
        console.print(means_table(title, measured.items(), order))
        for condition in found:
            console.print(str(condition), style="" if condition.passes else "red", soft_wrap=True)
        console.print()
        record[config.world] = {
            **{"fires": fires, "split": split, "headline": headline},
            "passes": all(condition.passes for condition in found),
            "conditions": [{**one._asdict(), "passes": one.passes} for one in found],
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
