"""Measures the ages of sightings: the steps since burning cells were last seen."""

import math

import torch
from torch import Tensor

from emberlink.envs.utils.buffers import Buffers

_EXACT = 512
"""ages below are counted one by one"""
_GROWTH = 1.01
"""ratio of the limits of the other classes of ages"""


def cell_ages(step: Tensor, last_seen: Tensor, ignition: Tensor) -> Tensor:
    """Returns the steps since each cell was last seen, from its ignition if it was not seen since.

    Args:
        step: [...], the current step.
        last_seen: [...], the step of the last look at the cell, negative for none.
        ignition: [...], the first step at which the cell burned.

    Returns:
        [...]; meaningful for burning cells.
    """
    return step - torch.maximum(last_seen, ignition)


def age_limits(horizon: int) -> Tensor:
    """Returns the lowest age of each class of the histogram, int64 [classes].

    Ages below 512 have a class each. Above, a class spans less than 1 % of its lowest age.
    """
    ages = list(range(min(_EXACT, horizon + 1)))
    while ages[-1] < horizon:
        ages.append(max(ages[-1] + 1, math.floor(ages[-1] * _GROWTH)))
    return torch.tensor(ages)


def percentile(histogram: Tensor, limits: Tensor, share: float) -> Tensor:
    """Returns the age that at least a share of all counted ages do not exceed.

    Args:
        histogram: int64 [..., classes], number of ages in each class.
        limits: int64 [classes], lowest age of each class.
        share: from 0 to 1.

    Returns:
        float32 [...]: the lowest age of the class in which the percentile lies (nearest rank); 0
        without any ages.
    """
    total = histogram.cumsum(-1)
    rank = (total[..., -1:].double() * share).ceil()
    place = (total < rank).sum(-1).clamp(max=len(limits) - 1)
    return limits.take(place).float()


class SightingAges(Buffers):
    """Accumulates the ages of burning cells over the steps of an episode.

    The memory does not grow with the number of steps.

    Args:
        envs: number of environments.
        horizon: steps of an episode.
    """

    total: Tensor
    """int64 [envs]: sum of all ages"""
    count: Tensor
    """int64 [envs]: number of ages"""
    histogram: Tensor
    """int64 [envs, classes]"""
    _limits: Tensor
    _class: Tensor

    def __init__(self, envs: int, horizon: int):
        super().__init__()
        limits = age_limits(horizon)
        classes = torch.searchsorted(limits, torch.arange(horizon + 1), right=True) - 1
        self.register_buffer("_limits", limits, persistent=False)
        self.register_buffer("_class", classes, persistent=False)
        for name in ("total", "count"):
            self.register_buffer(name, torch.zeros(envs, dtype=torch.int64))
        self.register_buffer("histogram", torch.zeros(envs, len(limits), dtype=torch.int64))

    def start_episodes(self, mask: Tensor) -> None:
        """Removes all ages of the environments of a mask, bool [envs]."""
        self.total.masked_fill_(mask, 0)
        self.count.masked_fill_(mask, 0)
        self.histogram.masked_fill_(mask[:, None], 0)

    def add(self, ages: Tensor, env: Tensor) -> None:
        """Adds the ages of one step.

        Args:
            ages: int64 [cells], at least 0.
            env: int64 [cells], the environment of each cell.
        """
        one = torch.ones_like(env)
        self.total.scatter_add_(0, env, ages)
        self.count.scatter_add_(0, env, one)
        place = self._class.take(ages).add_(env, alpha=len(self._limits))
        self.histogram.view(-1).scatter_add_(0, place, one)

    def mean(self) -> Tensor:
        """Returns the mean age, float32 [envs]; 0 without any ages."""
        return (self.total.double() / self.count.clamp(min=1)).float()

    def percentile(self, share: float) -> Tensor:
        """Returns a percentile of the ages, float32 [envs]; see `percentile`."""
        return percentile(self.histogram, self._limits, share)
