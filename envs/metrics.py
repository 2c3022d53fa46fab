"""The measures of an episode: pure functions of its steps.

`steps` is the "next" of each step of a `WildfireEnv`, batch size [..., T]; a measure is float32
[...]. Steps count from 1; an event that never happens counts as T, the horizon.
"""

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from emberlink.envs import keys
from emberlink.envs.config import WildfireConfig

Steps = Mapping[Any, Tensor]  # such as a TensorDict


def mean_reward(steps: Steps) -> Tensor:
    """Returns the mean reward over UAVs and steps, which depends on the setup (figure 5)."""
    return steps[keys.REWARD].squeeze(-1).float().mean((-2, -1))


def coverage(steps: Steps) -> Tensor:
    """Returns the share of burnt cells that a UAV saw, at the end of the episode, in % (figure 6).

    Seen are the cells that any UAV has seen while they burned. Burnt are the cells that burn or
    have burnt out. Where cells burn for ever, it is the share of burning cells that have been seen.
    100 where nothing has burnt.
    """
    return _share(steps, keys.SEEN)[..., -1]


def coverage_auc(steps: Steps) -> Tensor:
    """Returns the share of `coverage` averaged over all steps, in %."""
    return _share(steps, keys.SEEN).mean(-1)


def time_to_full_coverage(steps: Steps) -> Tensor:
    """Returns the first step at which every burnt cell has been seen while it burned.

    The horizon if there is none; 1 if nothing burns at the first step.
    """
    return _first_step(steps[keys.SEEN] == steps[keys.BURNT])


def tracking_first(steps: Steps) -> Tensor:
    """Returns the first step at which any UAV sees fire, else the horizon (figure 7)."""
    return _first_step(_on_fire(steps).mT).amin(-1)


def tracking_last(steps: Steps) -> Tensor:
    """Returns the first step by which every UAV has seen fire (figure 7).

    The horizon if a UAV never sees fire, also because it failed before.
    """
    return _first_step(_on_fire(steps).mT).amax(-1)


def boundary_exits(steps: Steps) -> Tensor:
    """Returns the attempted moves out of the box in x, y or z, mean over UAVs (figure 8)."""
    return steps[keys.HIT_BOUNDARY].any(-1).sum(-2).float().mean(-1)


def fire_losses(steps: Steps) -> Tensor:
    """Returns how often a UAV lost sight of fire, mean over UAVs (figure 9).

    A UAV that fails while it sees fire counts.
    """
    on_fire = _on_fire(steps)
    lost = on_fire[..., :-1, :] & ~on_fire[..., 1:, :]
    return lost.sum(-2).float().mean(-1)


def front_age(steps: Steps) -> Tensor:
    """Returns the mean age of sightings of the fire front, in steps.

    The age of a burning cell is the number of steps since any UAV last saw it, or since its
    ignition if none has. The mean is over all burning cells and steps.
    """
    return steps[keys.FRONT_AGE][..., -1]


def bytes_per_step(steps: Steps) -> Tensor:
    """Returns the bytes that a UAV sends in a step, mean over UAVs and steps.

    Of the scripted policies, `map_greedy`, `map_greedy_all` and `courier` send their map (2 bytes a
    cell, 4 if the horizon is above 32,766) and target (8 bytes), `follow_target` sends the messages
    of `consensus`, and the others send nothing.
    """
    return steps[keys.BYTES_SENT].double().mean((-2, -1)).float()


def base_coverage(steps: Steps) -> Tensor:
    """Returns the share of burnt cells with a sighting at the base, at the end, in %.

    The sighting was made while the cell burned.
    """
    return _share(steps, keys.BASE_SEEN)[..., -1]


def base_coverage_auc(steps: Steps) -> Tensor:
    """Returns the share of `base_coverage` averaged over all steps, in %."""
    return _share(steps, keys.BASE_SEEN).mean(-1)


def base_age(steps: Steps) -> Tensor:
    """Returns `front_age` by the sightings that have reached the base."""
    return steps[keys.BASE_AGE][..., -1]


def _share(steps: Steps, key: Any) -> Tensor:
    seen, burnt = steps[key], steps[keys.BURNT]
    return torch.where(burnt > 0, (100 * seen).float() / burnt.clamp(min=1), 100.0)


def _first_step(happened: Tensor) -> Tensor:
    """Returns the first true step (from 1), T without any: bool [..., T] -> float32 [...]."""
    horizon = happened.shape[-1]
    steps = torch.arange(1, horizon + 1, device=happened.device)
    return torch.where(happened, steps, horizon).amin(-1).float()


def _on_fire(steps: Steps) -> Tensor:
    """Returns whether each UAV sees fire, bool [..., T, n]."""
    return steps[keys.NEW_FIRE] + steps[keys.OLD_FIRE] > 0


_PAPER = (
    *(mean_reward, coverage, coverage_auc, time_to_full_coverage, tracking_first, tracking_last),
    *(boundary_exits, fire_losses),
)
_MEASURED = {front_age: keys.FRONT_AGE, bytes_per_step: keys.BYTES_SENT}
_OF_BASE = dict.fromkeys((base_coverage, base_coverage_auc, base_age), keys.BASE_SEEN)
"""measures that only some worlds have, and the key by which an episode shows that it has them"""

NAMES = tuple(measure.__name__ for measure in _PAPER)
"""the measures of every episode, the paper's first"""
MEASURED = tuple(measure.__name__ for measure in _MEASURED)
"""the measures that `measures: all` adds"""
OF_BASE = tuple(measure.__name__ for measure in _OF_BASE)
"""the measures that a base station adds"""
ALL = (*NAMES, *MEASURED, *OF_BASE)
HIGHER_IS_BETTER = frozenset(
    {"mean_reward", "coverage", "coverage_auc", "base_coverage", "base_coverage_auc"}
)
"""the measures to maximise; the others are to be minimised"""


def episode_metrics(steps: TensorDictBase) -> dict[str, Tensor]:
    """Returns every measure of one episode per environment.

    Args:
        steps: the "next" of each step of a `WildfireEnv`, batch size [..., T].

    Returns:
        float32 [...] for each of `NAMES`, and for the measured names of `MEASURED` and `OF_BASE`.
    """
    read: Any = steps
    some = {**_MEASURED, **_OF_BASE}
    more = [measure for measure, key in some.items() if read.get(key, None) is not None]
    return {measure.__name__: measure(read) for measure in (*_PAPER, *more)}


def names(world: WildfireConfig) -> tuple[str, ...]:
    """Returns the measures of an episode with communication in a world."""
    measured = MEASURED if world.measures == "all" else ()
    return (*NAMES, *measured, *(OF_BASE if world.base is not None else ()))


_COUNTED = (
    *(keys.REWARD, keys.SEEN, keys.BURNT),
    *(keys.NEW_FIRE, keys.OLD_FIRE, keys.HIT_BOUNDARY),
)
_AT_THE_END = (keys.FRONT_AGE, keys.BASE_AGE)
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
