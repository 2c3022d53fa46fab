"""Chooses what a UAV says in a step with a limit of bytes: what makes others' knowledge newest."""

import torch
from torch import Tensor


def said_within(
    limit: int, cells: tuple[Tensor, Tensor], places: Tensor, area: int, sizes: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """Returns which cells and positions UAVs say in a step.

    What is worth most is said first, until the next one does not fit. If that is a position, cells
    fill the bytes that are left. Of equal worth, positions come before cells, and larger indices
    before smaller ones.

    Args:
        limit: bytes of a UAV.
        cells: int64 [envs, n, k] each, what it is worth to say a cell, 0 for nothing, and its
            index. No cell of a UAV is worth something twice.
        places: int64 [envs, n, n], what it is worth to say the position of a UAV (column).
        area: number of cells.
        sizes: bytes of a cell and of a position.

    Returns:
        Masks of what is said, bool [envs, n, area] and [envs, n, n].
    """
    cell, place = sizes
    worth, index = cells
    uavs = torch.arange(area, area + places.shape[-1], device=places.device)
    worth, index = torch.cat((worth, places), -1), torch.cat((index, uavs.expand_as(places)), -1)
    entries = area + len(uavs)
    most = min(worth.shape[-1], limit // cell + len(uavs))
    best = torch.where(worth > 0, worth * entries + index, -1).topk(most, -1)[0]
    index = best.clamp(min=0) % entries
    is_place, is_cell = (best >= 0) & (index >= area), (best >= 0) & (index < area)
    is_place &= (place * is_place + cell * is_cell).cumsum(-1) <= limit
    left = limit - place * is_place.sum(-1, keepdim=True)
    is_cell &= cell * is_cell.cumsum(-1) <= left
    # What is not said is written behind the last entry.
    index = torch.where(is_place | is_cell, index, entries)
    shape = *worth.shape[:2], entries + 1
    said = torch.zeros(shape, dtype=torch.bool, device=worth.device).scatter_(-1, index, True)
    return said[..., :area], said[..., area:entries]
