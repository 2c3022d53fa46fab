"""The measures of an episode: pure functions of its steps.

`T` is the number of steps, `...` any batch (environments), `n` the UAVs. Steps count from 1; an
event that never happens counts as the horizon, T.
"""

import torch
from tensordict import TensorDictBase
from torch import Tensor

from emberlink.envs import keys

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
HIGHER_IS_BETTER = frozenset({"mean_reward", "coverage", "coverage_auc"})
"""the measures of which more is better; of the others less is better"""


def mean_reward(reward: Tensor) -> Tensor:
    """Returns the mean reward over UAVs and steps (figure 5): [..., T, n] -> [...]."""
    return reward.float().mean((-2, -1))


def coverage(seen: Tensor, burning: Tensor) -> Tensor:
    """Returns cells seen / cells burning at the end, in % (figure 6).

    Args:
        seen, burning: counts of cells after each step, [..., T].

    Returns:
        float32 [...]; 100 where nothing burns.
    """
    return _ratio(seen, burning)[..., -1]


def coverage_auc(seen: Tensor, burning: Tensor) -> Tensor:
    """Returns cells seen / cells burning, in %, averaged over steps. Arguments as `coverage`."""
    return _ratio(seen, burning).mean(-1)


def time_to_full_coverage(seen: Tensor, burning: Tensor) -> Tensor:
    """Returns the first step at which every burning cell is seen. Arguments as `coverage`."""
    return _first_step(seen == burning)


def tracking_first(on_fire: Tensor) -> Tensor:
    """Returns the first step at which any UAV sees fire (figure 7). on_fire bool [..., T, n]."""
    return _tracking(on_fire).amin(-1)


def tracking_last(on_fire: Tensor) -> Tensor:
    """Returns the first step by which every UAV has seen fire (figure 7). bool [..., T, n]."""
    return _tracking(on_fire).amax(-1)


def boundary_exits(left: Tensor) -> Tensor:
    """Returns attempted moves out of the box, mean over UAVs (figure 8). bool [..., T, n]."""
    return left.sum(-2).float().mean(-1)


def fire_losses(on_fire: Tensor) -> Tensor:
    """Returns how often a UAV lost sight of fire, mean over UAVs (figure 9). bool [..., T, n]."""
    lost = on_fire[..., :-1, :] & ~on_fire[..., 1:, :]
    return lost.sum(-2).float().mean(-1)


def episode_metrics(steps: TensorDictBase) -> dict[str, Tensor]:
    """Returns every measure of one episode per environment.

    Args:
        steps: the "next" of each step of a `WildfireEnv`, batch size [..., T].

    Returns:
        float32 [...] for each of `NAMES`.
    """
    reward = steps[keys.REWARD].squeeze(-1)
    seen, burning = steps[keys.SEEN], steps[keys.BURNING]
    on_fire = steps[keys.NEW_FIRE] + steps[keys.OLD_FIRE] > 0
    left = steps.get(keys.HIT_BOUNDARY).any(-1)
    return {
        "mean_reward": mean_reward(reward),
        "coverage": coverage(seen, burning),
        "coverage_auc": coverage_auc(seen, burning),
        "time_to_full_coverage": time_to_full_coverage(seen, burning),
        "tracking_first": tracking_first(on_fire),
        "tracking_last": tracking_last(on_fire),
        "boundary_exits": boundary_exits(left),
        "fire_losses": fire_losses(on_fire),
    }


STEP_KEYS = (
    keys.REWARD,
    keys.SEEN,
    keys.BURNING,
    keys.NEW_FIRE,
    keys.OLD_FIRE,
    keys.HIT_BOUNDARY,
)
"""the keys that `episode_metrics` reads"""


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
