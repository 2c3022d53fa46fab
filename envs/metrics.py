"""The measures of an episode: pure functions of its steps.

`T` is the number of steps, `...` any batch (environments), `n` the UAVs. Steps count from 1; an
event that never happens counts as the horizon, T.
"""

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from emberlink.envs import keys
from emberlink.envs.config import WildfireConfig

NAMES = (
    "mean_reward",
    "coverage",
    "coverage_auc",
    "time_to_full_coverage",
    "tracking_first",
    "tracking_last",
    "boundary_exits",
    "fire_losses",
)
"""the measures of every episode, the paper's first"""
MEASURED = ("front_age", "front_age_p95", "bytes_per_step")
"""the measures that `measures: all` adds"""
OF_BASE = ("base_coverage", "base_coverage_auc", "base_age")
"""the measures that a base station adds"""
ALL = (*NAMES, *MEASURED, *OF_BASE)
HIGHER_IS_BETTER = frozenset(
    {"mean_reward", "coverage", "coverage_auc", "base_coverage", "base_coverage_auc"}
)
"""the measures to maximise; the others are to be minimised"""


def mean_reward(reward: Tensor) -> Tensor:
    """Returns the mean reward over UAVs and steps (the paper's figure 5). It depends on the setup.

    Args:
        reward: [..., T, n].
    """
    return reward.float().mean((-2, -1))


def coverage(seen: Tensor, burnt: Tensor) -> Tensor:
    """Returns the share of burnt cells that a UAV saw, at the end of the episode, in % (figure 6).

    Seen are the cells that any UAV has seen while they burned. Burnt are the cells that burn or
    have burnt out. Where cells burn for ever, it is the share of burning cells that have been seen.

    Args:
        seen, burnt: counts of cells after each step, [..., T].

    Returns:
        float32 [...]; 100 where nothing has burnt.
    """
    return _ratio(seen, burnt)[..., -1]


def coverage_auc(seen: Tensor, burnt: Tensor) -> Tensor:
    """Returns the share of `coverage` averaged over all steps, in %.

    Args:
        seen, burnt: as for `coverage`.
    """
    return _ratio(seen, burnt).mean(-1)


def time_to_full_coverage(seen: Tensor, burnt: Tensor) -> Tensor:
    """Returns the first step at which every burnt cell has been seen while it burned.

    The horizon if there is none; 1 if nothing burns at the first step.

    Args:
        seen, burnt: as for `coverage`.
    """
    return _first_step(seen == burnt)


def tracking_first(on_fire: Tensor) -> Tensor:
    """Returns the first step at which any UAV sees fire; the horizon if there is none (figure 7).

    Args:
        on_fire: whether a UAV sees fire, bool [..., T, n].
    """
    return _tracking(on_fire).amin(-1)


def tracking_last(on_fire: Tensor) -> Tensor:
    """Returns the first step by which every UAV has seen fire (figure 7).

    The horizon if a UAV never sees fire, also because it failed before.

    Args:
        on_fire: as for `tracking_first`.
    """
    return _tracking(on_fire).amax(-1)


def boundary_exits(left: Tensor) -> Tensor:
    """Returns the attempted moves out of the box in x, y or z, mean over UAVs (figure 8).

    Args:
        left: whether a move would have left the box, bool [..., T, n].
    """
    return left.sum(-2).float().mean(-1)


def fire_losses(on_fire: Tensor) -> Tensor:
    """Returns how often a UAV lost sight of fire, mean over UAVs (figure 9).

    A UAV that fails while it sees fire counts.

    Args:
        on_fire: as for `tracking_first`.
    """
    lost = on_fire[..., :-1, :] & ~on_fire[..., 1:, :]
    return lost.sum(-2).float().mean(-1)


def front_age(ages: Tensor) -> Tensor:
    """Returns the mean age of sightings of the fire front, in steps.

    The age of a burning cell is the number of steps since any UAV last saw it, or since its
    ignition if none has. The mean is over all burning cells and steps.

    Args:
        ages: `keys.FRONT_AGE` after each step, the mean up to that step, [..., T].
    """
    return ages[..., -1]


def front_age_p95(ages: Tensor) -> Tensor:
    """Returns the 95th percentile of the ages of `front_age`.

    Above 511 steps it is rounded down by less than 1 %.

    Args:
        ages: `keys.FRONT_AGE_P95` after each step, [..., T].
    """
    return ages[..., -1]


def bytes_per_step(sent: Tensor) -> Tensor:
    """Returns the bytes that a UAV sends in a step, mean over UAVs and steps.

    Of the scripted policies, `map_greedy`, `map_greedy_all` and `courier` send their map (2 bytes a
    cell, 4 if the horizon is above 32,766) and target (8 bytes), `follow_target` sends the messages
    of `consensus`, and the others send nothing.

    Args:
        sent: `keys.BYTES_SENT` after each step, int64 [..., T, n].
    """
    return sent.double().mean((-2, -1)).float()


def base_coverage(seen: Tensor, burnt: Tensor) -> Tensor:
    """Returns the share of burnt cells with a sighting at the base, at the end, in %.

    The sighting was made while the cell burned.

    Args:
        seen: `keys.BASE_SEEN` after each step, [..., T].
        burnt: as for `coverage`.
    """
    return _ratio(seen, burnt)[..., -1]


def base_coverage_auc(seen: Tensor, burnt: Tensor) -> Tensor:
    """Returns the share of `base_coverage` averaged over all steps, in %.

    Args:
        seen, burnt: as for `base_coverage`.
    """
    return coverage_auc(seen, burnt)


def base_age(ages: Tensor) -> Tensor:
    """Returns `front_age` by the sightings that have reached the base.

    Args:
        ages: `keys.BASE_AGE` after each step, [..., T].
    """
    return ages[..., -1]


def episode_metrics(steps: TensorDictBase) -> dict[str, Tensor]:
    """Returns every measure of one episode per environment.

    Args:
        steps: the "next" of each step of a `WildfireEnv`, batch size [..., T].

    Returns:
        float32 [...] for each of `NAMES`, and for the measured names of `MEASURED` and `OF_BASE`.
    """
    reward = steps[keys.REWARD].squeeze(-1)
    seen, burnt = steps[keys.SEEN], steps[keys.BURNT]
    on_fire = steps[keys.NEW_FIRE] + steps[keys.OLD_FIRE] > 0
    left = steps.get(keys.HIT_BOUNDARY).any(-1)
    measured = {
        "mean_reward": mean_reward(reward),
        "coverage": coverage(seen, burnt),
        "coverage_auc": coverage_auc(seen, burnt),
        "time_to_full_coverage": time_to_full_coverage(seen, burnt),
        "tracking_first": tracking_first(on_fire),
        "tracking_last": tracking_last(on_fire),
        "boundary_exits": boundary_exits(left),
        "fire_losses": fire_losses(on_fire),
    }
    if steps.get(keys.FRONT_AGE, None) is not None:
        measured["front_age"] = front_age(steps[keys.FRONT_AGE])
        measured["front_age_p95"] = front_age_p95(steps[keys.FRONT_AGE_P95])
    if steps.get(keys.BYTES_SENT, None) is not None:
        measured["bytes_per_step"] = bytes_per_step(steps[keys.BYTES_SENT])
    if steps.get(keys.BASE_SEEN, None) is not None:
        measured["base_coverage"] = base_coverage(steps[keys.BASE_SEEN], burnt)
        measured["base_coverage_auc"] = base_coverage_auc(steps[keys.BASE_SEEN], burnt)
        measured["base_age"] = base_age(steps[keys.BASE_AGE])
    return measured


def names(world: WildfireConfig) -> tuple[str, ...]:
    """Returns the measures of an episode with communication in a world."""
    measured = MEASURED if world.measures == "all" else ()
    return (*NAMES, *measured, *(OF_BASE if world.base is not None else ()))


_COUNTED = (
    keys.REWARD,
    keys.SEEN,
    keys.BURNT,
    keys.NEW_FIRE,
    keys.OLD_FIRE,
    keys.HIT_BOUNDARY,
)
_AT_THE_END = (keys.FRONT_AGE, keys.FRONT_AGE_P95, keys.BASE_AGE)
"""keys whose last step `episode_metrics` reads; only some worlds have them"""


def counted(world: WildfireConfig) -> tuple[Any, ...]:
    """Returns the keys whose every step `episode_metrics` reads, beside `keys.BYTES_SENT`."""
    return _COUNTED if world.base is None else (*_COUNTED, keys.BASE_SEEN)


def measured_steps(steps: TensorDictBase) -> TensorDictBase:
    """Returns what `episode_metrics` reads, with an entry for each step of a held action.

    Args:
        steps: the "next" of successive steps or decisions of a `WildfireEnv`, batch size [..., T].
    """
    read = steps.select(*_COUNTED, keys.BASE_SEEN, keys.BYTES_SENT, *_AT_THE_END, strict=False)
    series = steps.get(keys.STEPS, None)
    if series is None:
        return read
    repeated: Any = read.unsqueeze(-1).expand(*steps.shape, series.shape[-1])
    result: Any = repeated.clone(False).update(series)
    return result.flatten(-2, -1)


def _ratio(seen: Tensor, burning: Tensor) -> Tensor:
    return torch.where(burning > 0, (100 * seen).float() / burning.clamp(min=1), 100.0)


def _first_step(happened: Tensor) -> Tensor:
    """Returns the first true step (from 1), T without any: bool [..., T] -> float32 [...]."""
    horizon = happened.shape[-1]
    steps = torch.arange(1, horizon + 1, device=happened.device)
    return torch.where(happened, steps, horizon).amin(-1).float()


def _tracking(on_fire: Tensor) -> Tensor:
    """Returns the first step on fire per UAV: bool [..., T, n] -> float32 [..., n]."""
    return _first_step(on_fire.transpose(-1, -2))
