"""Plays the scripted policies of a world on its fires."""

from collections.abc import Callable, Sequence
from typing import Literal

from emberlink.envs.scenarios import fires_of
from emberlink.envs.utils.errors import UserError
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.evaluation.evaluate import BLOCK, VALIDATION_START_SEED, play_scripted
from emberlink.trainers.evaluation.results import Measured

Split = Literal["test", "validation"]
ALONE, IN_RANGE, ALL = "map_greedy_alone", "map_greedy", "map_greedy_all"
RANDOM, ORACLE = "random_waypoints", "oracle"
SHARES = ("coverage", "coverage_auc", "base_coverage")
"""measures in %, of which more is better: the possible headlines of a calibrated world"""
_METHOD = "independent"  # any method; scripted policies do not depend on it


def world_config(overrides: Sequence[str]) -> RunConfig:
    """Returns the configuration of a world: `world=NAME` and other `key=value`.

    Raises:
        UserError: a key or value is wrong, or the headline is not a share.
    """
    config = resolve(_METHOD, overrides)
    headline = config.evaluation.headline
    if headline not in SHARES:
        raise UserError(
            f"world {config.world}: evaluation.headline={headline} is not a share in %; "
            f"known: {', '.join(SHARES)}"
        )
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

    Args:
        config: configuration of the world.
        policy: a name in `SCRIPTED`.
        fires: number of fires, one episode each.
        split: test fires as in an evaluation, or validation fires as during a training.
        report: called with the name if the policy is played.
    """
    if split == "validation":
        return play_validation(config, policy, fires, report)
    arrival = fires_of(config.fire).test(fires, config.env.grid, config.env.horizon)
    return play_scripted(config, policy, arrival, report=report)


def play_validation(
    config: RunConfig, policy: str, fires: int, report: Callable[[str], None] = lambda _: None
) -> Measured:
    """Returns the measures of a scripted policy on validation fires; arguments as `played`."""
    arrival = fires_of(config.fire).validation(fires, config.env.grid, config.env.horizon)
    start, block = VALIDATION_START_SEED, min(fires, BLOCK)
    return play_scripted(config, policy, arrival, start_seed=start, block=block, report=report)
