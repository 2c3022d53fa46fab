"""States what a world of the suite has to satisfy, by the means of scripted policies."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass

from emberlink.trainers.worlds.play import ALL, ALONE, ORACLE, RANDOM

NEEDED = (RANDOM, ALONE, ALL, ORACLE)
"""the scripted policies on which the conditions depend"""
MOST_AT_RANDOM = 50.0
"""%; random waypoints may reach at most this much of the headline"""
LEAST_OF_ORACLE = 90.0
"""%; the oracle has to reach at least this much of the headline"""
LEAST_GAIN = 10.0
"""what merging all maps has to add to merging none: points of the headline, or % of `front_age`"""

Means = Mapping[str, Mapping[str, float]]
"""policy -> measure -> mean over episodes"""


@dataclass(frozen=True)
class Condition:
    """A bound on one figure or several of a world, of which one suffices."""

    name: str
    """the policies that are measured"""
    figures: Mapping[str, float]
    """what is measured, with its unit -> number"""
    bound: float
    at_most: bool = False
    """whether the bound is an upper one"""

    @property
    def passes(self) -> bool:
        """Whether at least one of the figures keeps the bound."""
        if self.at_most:
            return any(number <= self.bound for number in self.figures.values())
        return any(number >= self.bound for number in self.figures.values())


def missing(policies: Collection[str]) -> list[str]:
    """Returns the policies of `NEEDED` that a world does not evaluate."""
    return [name for name in NEEDED if name not in policies]


def conditions(means: Means, headline: str) -> list[Condition]:
    """Returns the conditions of a world.

    Args:
        means: the measures of at least the policies of `NEEDED`.
        headline: the world's headline measure, in %.
    """
    none, merged = means[ALONE], means[ALL]
    gains = {f"{headline}, points": merged[headline] - none[headline]}
    if none.get("front_age"):
        saved = none["front_age"] - merged["front_age"]
        gains["front_age, % less"] = 100 * saved / none["front_age"]
    share = f"{headline}, %"
    return [
        Condition(RANDOM, {share: means[RANDOM][headline]}, MOST_AT_RANDOM, at_most=True),
        Condition(ORACLE, {share: means[ORACLE][headline]}, LEAST_OF_ORACLE),
        Condition(f"{ALL} against {ALONE}", gains, LEAST_GAIN),
    ]
