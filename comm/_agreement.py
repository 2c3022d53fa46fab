"""The agreement of a network of UAVs on whom to follow (paper, algorithm 3)."""

import torch
from torch import Tensor


def known_discoverers(hears: Tensor, discovers: Tensor, *, agree: bool = True) -> Tensor:
    """Returns the discoverers that each UAV knows of after the exchange, bool [..., n, n].

    A non-discoverer hears the discoverers among its neighbours. Non-discoverers that are connected
    through non-discoverers then know of all discoverers that any of them hears.

    Args:
        hears: bool [..., n, n], whether a UAV (row) hears another one (column).
        discovers: bool [..., n].
        agree: whether non-discoverers tell each other.
    """
    uavs = discovers.shape[-1]
    known = hears & discovers.unsqueeze(-2)
    if not agree:
        return known
    # Neighbours exchange once per round; k squarings of the matrix reach all within 2**k hops.
    others = ~discovers
    identity = torch.eye(uavs, dtype=torch.bool, device=hears.device)
    within = ((hears & others.unsqueeze(-1) & others.unsqueeze(-2)) | identity).float()
    for _ in range((uavs - 1).bit_length()):
        within = (within @ within).clamp_(max=1)
    return (within @ known.float()) > 0


def choose_leader(known: Tensor, cost: Tensor, discovers: Tensor) -> Tensor:
    """Returns whom each UAV follows, int64 [..., n]: itself if a discoverer, -1 if nobody.

    Args:
        known: bool [..., n, n], the discoverers that a UAV (row) knows of.
        cost: [..., n or 1, n]; the lowest is chosen, among equals the lower index.
        discovers: bool [..., n].
    """
    uavs = discovers.shape[-1]
    # Positions in the sorted order differ, so that the minimum is the same on every device.
    order = torch.sort(cost, dim=-1, stable=True).indices.argsort(-1)
    best, leader = order.masked_fill(~known, uavs).min(-1)
    leader = torch.where(best < uavs, leader, -1)
    return torch.where(discovers, torch.arange(uavs, device=leader.device), leader)
