"""The arrangement of observations by the weights that read them."""

import math

import torch
from torch import Tensor


class Grouping:
    """Arranges the UAVs' tensors by groups: the inputs of one group are read by the same weights.

    With weights per UAV, a group is a UAV; with shared weights, it is a team. Several teams that
    train side by side, one per seed, share no weights; the groups of team 0 come first.

    Tensors have the UAVs of all teams, [..., teams * uavs, *features], or, while transitions are
    collected, those of one team, [teams * envs, uavs, *features] with the environments of team 0
    first.

    Args:
        uavs: UAVs of a team.
        teams: number of teams.
        shared: whether the UAVs of a team share their weights.
    """

    def __init__(self, uavs: int, teams: int = 1, *, shared: bool = False):
        self.uavs, self.teams, self.shared = uavs, teams, shared

    @property
    def groups(self) -> int:
        """Number of groups."""
        return self.teams if self.shared else self.teams * self.uavs

    def split(self, x: Tensor, batch: torch.Size) -> Tensor:
        """[*batch, *features] -> [groups, rows, *features].

        Args:
            x: the UAVs' tensors.
            batch: [..., uavs] or [..., teams * uavs].
        """
        features = x.shape[len(batch) :]
        x = x.reshape(math.prod(batch[:-1]), batch[-1], *features)
        if batch[-1] == self.uavs:
            x = x.unflatten(0, (self.teams, -1))
        else:
            x = x.unflatten(1, (self.teams, -1)).transpose(0, 1)
        # [teams, rows, uavs, *features]
        return x.flatten(1, 2) if self.shared else x.transpose(1, 2).flatten(0, 1)

    def join(self, x: Tensor, batch: torch.Size) -> Tensor:
        """[groups, rows, features] -> [*batch, features]; the reverse of `split`."""
        if self.shared:
            x = x.unflatten(1, (-1, self.uavs))
        else:
            x = x.unflatten(0, (self.teams, -1)).transpose(1, 2)
        if batch[-1] != self.uavs:
            x = x.transpose(0, 1)
        return x.reshape(*batch, x.shape[-1])
