"""Draws the steps at which UAVs fail."""

import torch
from torch import Tensor

from emberlink.envs.utils import counter_rng
from emberlink.envs.utils.counter_rng import Use


def draw_failures(episode_key: Tensor, expected: float, uavs: int, horizon: int) -> Tensor:
    """Draws the step from which each UAV has failed, int64 [..., uavs].

    Each UAV fails with probability `expected / uavs`, independently, at a step that is uniform from
    1 to the horizon.

    Returns:
        Steps; `horizon + 1` for a UAV that does not fail.
    """
    unit = counter_rng.uniform(counter_rng.fold_in(episode_key, Use.FAILURE), 2 * uavs)
    fails, when = unit.unflatten(-1, (2, uavs)).unbind(-2)
    step = 1 + (when.double() * horizon).long()
    return torch.where(fails < expected / uavs, step, horizon + 1)
