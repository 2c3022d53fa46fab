"""Max-consensus of a network of UAVs on the discoverer to follow (paper, algorithm 3)."""

import torch
from torch import Tensor

from emberlink.envs.world.radio import reachable


def known_discoverers(hears: Tensor, discovers: Tensor, *, agree: bool = True) -> Tensor:
    """Returns the discoverers that each UAV knows after the exchange, bool [..., n, n].

    A non-discoverer hears the discoverers among its neighbours. Non-discoverers in the same
    connected sub-network of non-discoverers then share the discoverers that any of them hears.

    Args:
        hears: bool [..., n, n], whether a UAV (row) hears another one (column).
        discovers: bool [..., n], whether a UAV is a discoverer.
        agree: whether non-discoverers share the discoverers that they hear.
    """
    known = hears & discovers.unsqueeze(-2)
    if not agree:
        return known
    others = ~discovers
    within = reachable(hears & others.unsqueeze(-1) & others.unsqueeze(-2)).float()
    return (within @ known.float()) > 0


def choose_leader(known: Tensor, cost: Tensor, discovers: Tensor) -> Tensor:
    """Returns the index of the discoverer that each UAV follows, int64 [..., n].

    A discoverer follows itself. The index is -1 for a UAV that knows no discoverer.

    Args:
        known: bool [..., n, n], the discoverers that a UAV (row) knows of.
        cost: [..., n or 1, n], of following a UAV (column). Each UAV chooses the discoverer of
            lowest cost, and of equal costs the lower index.
        discovers: bool [..., n], whether a UAV is a discoverer.
    """
    uavs = discovers.shape[-1]
    # Ranks have no ties, so the minimum is the same on every device.
    order = torch.sort(cost, dim=-1, stable=True).indices.argsort(-1)
    best, leader = order.masked_fill(~known, uavs).min(-1)
    leader = torch.where(best < uavs, leader, -1)
    return torch.where(discovers, torch.arange(uavs, device=leader.device), leader)
