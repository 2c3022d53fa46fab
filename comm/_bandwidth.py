"""Chooses what a UAV says in a step with a limit of bytes: what is worth most to those in range."""

from typing import NamedTuple

import torch
from torch import Tensor

from emberlink.comm._messages import News, could_tell
from emberlink.envs.world.knowledge import Knowledge

OLD = 100
"""steps; a look that is newer by more is not worth more"""


class Offers(NamedTuple):
    """The new cells of UAVs, those that are worth most first: int64 [envs, n, k] each."""

    worth: Tensor
    """0 behind the last one"""
    cell: Tensor


def offers(known: Knowledge, near: Tensor, news: News | None, most: int) -> Offers:
    """Returns the new cells that are worth most, at most `most` for each UAV.

    A cell is worth the steps by which the last look of each UAV in range gets newer, at most
    `OLD`, summed over them. A UAV that has not looked, or that does not know that the cell was
    seen while it burned, counts as one that looked at step -1. Of equal worth, the cells that a
    UAV offers first depend on its number, so that UAVs offer different ones.

    Args:
        known: the maps.
        near: bool [envs, n, n], whether a UAV (row) is in range of another one (column).
        news: what `CellMessages.compare` returned.
        most: number of cells.
    """
    last, seen = known.last_seen, known.seen_fire
    assert seen is not None
    if news is None:
        return _offers_dense(last, seen, near, most)
    told, entry, theirs = news
    envs, uavs, area = last.shape
    was_fire = seen.take(told)[entry] & ~seen.take(theirs)
    gained = _gained(last.take(told)[entry], last.take(theirs), was_fire)
    worth = torch.zeros_like(told).index_add_(0, entry, gained)
    row, cell, most_worth = told // area, told % area, uavs * OLD
    turned = _turned(cell, row % uavs, uavs, area)
    order = ((row * most_worth + most_worth - worth) * area + turned).argsort()
    count = row.bincount(minlength=envs * uavs)  # the rows ascend, and sorting does not move them
    rank = torch.arange(len(row)) - (count.cumsum(0) - count)[row]
    best = rank < most
    place, first = (row[best], rank[best]), order[best]
    result = Offers(*torch.zeros(2, envs * uavs, min(most, int(count.max())), dtype=torch.int64))
    result.worth[place], result.cell[place] = worth[first], cell[first]
    return Offers(*(x.unflatten(0, (envs, uavs)) for x in result))


def worth_of_places(stamp: Tensor, near: Tensor) -> Tensor:
    """Returns what it is worth to say positions: the steps by which they get newer.

    Args:
        stamp: int64 [envs, n, n], the step at which a UAV (row) knows the position of another one
            (column), -1 for never.
        near: see `offers`.

    Returns:
        int64 [envs, n, n], summed over the UAVs in range of the speaker (row).
    """
    # [envs, hearers, speakers, known]
    gained = (stamp.unsqueeze(1) - stamp.unsqueeze(2)).clamp(min=0)
    return (gained * near.unsqueeze(-1)).sum(1)


def said_within(
    limit: int, cells: Offers, places: Tensor, area: int, sizes: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """Returns which cells and positions UAVs say in a step.

    What is worth most is said first, until the next one does not fit. If that is a position, cells
    fill the bytes that are left. Of equal worth, cells come before positions.

    Args:
        limit: bytes of a UAV.
        cells: the new cells; those that fit if there are no positions, or more.
        places: int64 [envs, n, n], what it is worth to say the position of a UAV (column), 0 for
            nothing.
        area: number of cells.
        sizes: bytes of a cell and of a position.

    Returns:
        Masks of what is said, bool [envs, n, area] and [envs, n, n].
    """
    cell, place = sizes
    uavs = torch.arange(area, area + places.shape[-1], device=places.device)
    index = torch.cat((cells.cell, uavs.expand_as(places)), -1)
    worth, order = torch.cat((cells.worth, places), -1).sort(stable=True, descending=True)
    index = index.gather(-1, order)
    is_place, is_cell = (worth > 0) & (index >= area), (worth > 0) & (index < area)
    is_place &= (place * is_place + cell * is_cell).cumsum(-1) <= limit
    left = limit - place * is_place.sum(-1, keepdim=True)
    is_cell &= cell * is_cell.cumsum(-1) <= left
    # What is not said is written behind the last entry.
    entries = area + len(uavs)
    index = torch.where(is_place | is_cell, index, entries)
    shape = *worth.shape[:2], entries + 1
    said = torch.zeros(shape, dtype=torch.bool, device=worth.device).scatter_(-1, index, True)
    return said[..., :area], said[..., area:entries]


def _gained(told: Tensor, theirs: Tensor, fire_is_new: Tensor) -> Tensor:
    """Returns the steps by which looks get newer, int64, at most `OLD`."""
    known = torch.where(fire_is_new, -1, theirs.long() >> 2)
    return ((told.long() >> 2) - known).clamp(max=OLD)


def _turned(cell: Tensor, turns: Tensor | int, uavs: int, area: int) -> Tensor:
    """Returns indices of cells, turned by a share of the map for each of `uavs` turns."""
    return (cell + turns * (area // uavs)) % area


def _offers_dense(last: Tensor, seen: Tensor, near: Tensor, most: int) -> Offers:
    """Computes `offers` from all maps, and never waits for the device."""
    parts, (_, uavs, area) = [], last.shape
    cells = torch.arange(area, device=last.device)
    for uav in range(uavs):
        told, told_seen = last[:, uav : uav + 1], seen[:, uav : uav + 1]
        gained = _gained(told, last, told_seen & ~seen) * could_tell(last, seen, near, uav)
        first = area - 1 - _turned(cells, uav, uavs, area)
        best, index = (gained.sum(1) * area + first).topk(min(most, area), -1)
        parts.append(Offers(best // area, index))
    return Offers(*(torch.stack(part, 1) for part in zip(*parts, strict=True)))
