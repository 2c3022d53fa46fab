"""Arranges inputs by the group of weights that they are multiplied with."""

import math

import torch
from torch import Tensor


class Grouping:
    """Arranges tensors of UAVs by group; the inputs of a group use the same weights.

    With weights per UAV, a group is a UAV; with shared weights, there is one group.
    """

    def __init__(self, uavs: int, *, shared: bool = False):
        self.uavs, self.shared = uavs, shared
        self.groups = 1 if shared else uavs
        """number of groups"""

    def split(self, x: Tensor, batch: torch.Size) -> Tensor:
        """Maps [*batch, *features], with the batch [..., uavs], to [groups, rows, *features]."""
        features = x.shape[len(batch) :]
        if self.shared:
            return x.reshape(1, math.prod(batch), *features)
        return x.reshape(math.prod(batch[:-1]), self.uavs, *features).transpose(0, 1)

    def join(self, x: Tensor, batch: torch.Size) -> Tensor:
        """Reverses `split`: maps [groups, rows, features] to [*batch, features]."""
        x = x.squeeze(0) if self.shared else x.transpose(0, 1)
        return x.reshape(*batch, x.shape[-1])

    def with_index(self, x: Tensor) -> Tensor:
        """Appends to [..., uavs, features] a 1 at the index of the UAV and 0 elsewhere."""
        index = torch.eye(self.uavs, dtype=x.dtype, device=x.device)
        return torch.cat((x, index.expand(*x.shape[:-1], -1)), -1)

    def of_team(self, x: Tensor, dims: int) -> Tensor:
        """Joins the features of all UAVs of the team, per UAV, its own first.

        UAV k gets the order k, k + 1, ..., 0, ..., k - 1.

        Args:
            x: [*batch, features, ...], with the batch [..., uavs].

        Returns:
            [*batch, uavs * features, ...].
        """
        own = torch.arange(self.uavs, device=x.device)
        order = (own[:, None] + own) % self.uavs
        members = x.index_select(dims - 1, order.flatten()).unflatten(dims - 1, order.shape)
        return members.flatten(dims, dims + 1)
