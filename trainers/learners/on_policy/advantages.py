"""Estimates advantages and returns of whole episodes."""

from typing import Any

import torch
from torch import Tensor
from torchrl.objectives.value.functional import generalized_advantage_estimate

_KEPT = 0.9
"""share of the earlier spread of the returns that is kept from episode to episode"""


class Advantages:
    """Estimates advantages (GAE, Schulman et al. 2016), and scales them and the returns.

    The horizon truncates an episode and does not end the world: the value of the last observation
    stands for what would follow. The episode of a UAV that fails is truncated there, too: the value
    of the observation after its last decision stands for what would follow.

    Args:
        gamma: discount per decision.
        lam: the factor lambda of GAE.
        groups: number of seeds, and of networks of a seed; each has its own scale.
        device: of all tensors.
    """

    def __init__(
        self, gamma: float, lam: float, groups: tuple[int, int], device: torch.device | str
    ):
        self.gamma, self.lam, self.groups = gamma, lam, groups
        self.spread = torch.zeros(groups, dtype=torch.float32, device=device)
        """standard deviation of returns, averaged over iterations; the unit of the critics'
        values; 0 before the first iteration"""

    def estimate(
        self, value: Tensor, reward: Tensor, alive: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Returns advantages, standardised, and returns in units of the new `spread`.

        Args:
            value: float32 [seeds * envs, decisions + 1, uavs, 1], in units of the old `spread`.
            reward: float32 [seeds * envs, decisions, uavs, 1].
            alive: bool [seeds * envs, decisions, uavs], whether a UAV still flew after a
                decision; None if UAVs do not fail.
        """
        unit = torch.where(self.spread > 0, self.spread, 1.0)
        value = self._scaled(value, unit)
        flew = torch.ones_like(reward, dtype=torch.bool) if alive is None else alive.unsqueeze(-1)
        # A trajectory ends before a decision that the UAV does not survive.
        ends = torch.cat((~flew[:, 1:], torch.ones_like(flew[:, :1])), 1)
        estimate: Any = generalized_advantage_estimate
        advantage, returns = estimate(
            self.gamma,
            self.lam,
            value[:, :-1],
            value[:, 1:],
            reward,
            ends,
            torch.zeros_like(ends),
            time_dim=1,
        )
        mean, std = self._moments(advantage, flew)
        advantage = self._scaled(self._scaled(advantage, -mean, add=True), 1 / (std + 1e-8))
        _, spread = self._moments(returns, flew)
        kept = (self.spread > 0).to(self.spread.dtype) * _KEPT
        self.spread.copy_(torch.lerp(spread, self.spread, kept).clamp(min=1e-6))
        return advantage, self._scaled(returns, 1 / self.spread)

    def _moments(self, x: Tensor, flew: Tensor) -> tuple[Tensor, Tensor]:
        """Returns mean and standard deviation of each group, over the decisions in flight."""
        grouped, weight = self._grouped(x), self._grouped(flew.to(x.dtype))
        count = weight.sum(-1).clamp(min=1)
        mean = (grouped * weight).sum(-1) / count
        squares = (grouped - mean.unsqueeze(-1)).square() * weight
        return mean, (squares.sum(-1) / count).sqrt()

    def _grouped(self, x: Tensor) -> Tensor:
        """Maps [seeds * envs, decisions, uavs, 1] to [seeds, networks, the rest]."""
        seeds, networks = self.groups
        x = x.unflatten(0, (seeds, -1)).unflatten(3, (networks, -1))
        return x.permute(0, 3, 1, 2, 4, 5).flatten(2)

    def _scaled(self, x: Tensor, factor: Tensor, *, add: bool = False) -> Tensor:
        """Multiplies [seeds * envs, decisions, uavs, 1] by a factor per group, or adds it."""
        seeds, networks = self.groups
        grouped = x.unflatten(0, (seeds, -1)).unflatten(3, (networks, -1))
        factor = factor[:, None, None, :, None, None]
        grouped = grouped + factor if add else grouped * factor
        return grouped.flatten(3, 4).flatten(0, 1)
