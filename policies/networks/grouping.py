"""Arranges inputs by the group of weights that they are multiplied with."""

import math

import torch
from torch import Tensor


class Grouping:
    """Arranges tensors of UAVs by group; the inputs of a group use the same weights.

    With weights per UAV, a group is a UAV; with shared weights, it is a team. Several teams that
    are trained in parallel, one per seed, share no weights. The groups of team 0 come first.

    In a batch of the replay buffer, the UAVs of all teams are in one dimension,
    [..., teams * uavs, *features]. While transitions are collected, the teams are in the dimension
    of the environments, [teams * envs, uavs, *features], those of team 0 first.

    Args:
        uavs: number of UAVs in a team.
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
        """Maps [*batch, *features] to [groups, rows, *features].

        Args:
            x: a tensor of UAVs.
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
        """Reverses `split`: maps [groups, rows, features] to [*batch, features]."""
        if self.shared:
            x = x.unflatten(1, (-1, self.uavs))
        else:
            x = x.unflatten(0, (self.teams, -1)).transpose(1, 2)
        if batch[-1] != self.uavs:
            x = x.transpose(0, 1)
        return x.reshape(*batch, x.shape[-1])

    def with_index(self, x: Tensor) -> Tensor:
        """Appends to the features of each UAV, [..., features], a 1 at its index and 0 elsewhere.

        Args:
            x: [..., uavs, features] or [..., teams * uavs, features].
        """
        index = torch.eye(self.uavs, dtype=x.dtype, device=x.device)
        index = index.repeat(x.shape[-2] // self.uavs, 1)
        return torch.cat((x, index.expand(*x.shape[:-1], -1)), -1)

    def of_team(self, x: Tensor, dims: int, uav_dim: int | None = None) -> Tensor:
        """Joins the first features of all UAVs of a team, those of the UAV itself first.

        Those of UAV k + 1 follow, and so on; UAV 0 follows the last one.

        Args:
            x: [*batch, features, ...].
            dims: number of dimensions of the batch.
            uav_dim: the dimension of the batch with UAVs, [uavs] or [teams * uavs]; the last one
                if None.

        Returns:
            [*batch, uavs * features, ...].
        """
        uav_dim = dims - 1 if uav_dim is None else uav_dim
        own = torch.arange(self.uavs, device=x.device)
        order = (own[:, None] + own) % self.uavs
        x = x.unflatten(uav_dim, (-1, self.uavs))
        # [..., teams, uavs, members, ...] -> members in front of the features
        members = x.index_select(uav_dim + 1, order.flatten()).unflatten(uav_dim + 1, order.shape)
        return (
            members.flatten(uav_dim, uav_dim + 1).movedim(uav_dim + 1, dims).flatten(dims, dims + 1)
        )

    def joint(self, own: Tensor, taken: Tensor) -> Tensor:
        """Joins a UAV's own action and the actions of the other UAVs, in the order of `of_team`.

        Args:
            own: [batch, uavs, ..., actions].
            taken: the actions of the others, of the same shape; those of `own` if it has no
                components.

        Returns:
            [batch, uavs, ..., uavs * actions].
        """
        others = taken if taken.shape[-1] else own
        team = self.of_team(others, own.ndim - 1, 1)
        return torch.cat((own, team[..., own.shape[-1] :]), -1)
