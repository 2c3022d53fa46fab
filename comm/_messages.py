"""Passes on maps and positions between UAVs, within a limit of bytes."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from emberlink.envs.world.coverage_map import View, mark, own_maps
from emberlink.envs.world.knowledge import Knowledge

OLD = 100
"""largest gain of a look for one hearer, steps"""
_COMPARED = 2**11
"""pairs of maps that are compared at a time"""


class News(NamedTuple):
    """The cells that are new to UAVs in range, as indices into flat maps [envs * n * area]."""

    told: Tensor
    """int64 [k], entries of the speakers' maps, sorted"""
    row: Tensor
    """int64 [m], index into `told`, sorted"""
    theirs: Tensor
    """int64 [m], entry of the hearer's map"""


def cell_bytes(horizon: int) -> int:
    """Returns the bytes of a message about a cell: index (2), step of the last look, state (1)."""
    return 2 + _bytes_of_step(horizon) + 1


def place_bytes(horizon: int) -> int:
    """Returns the bytes of a message about a position: UAV (2), step, three float32 numbers."""
    return 2 + _bytes_of_step(horizon) + 12


def _bytes_of_step(horizon: int) -> int:
    return 2 if horizon < 2**16 else 4


def pass_on_places(
    stamp: Tensor, place: Tensor, near: Tensor, hears: Tensor, chosen: Tensor | None, size: int
) -> Tensor:
    """Passes on the positions that UAVs know of each other, in place.

    A UAV says a position if a UAV in range knows an older one or none.

    Args:
        stamp: int64 [envs, n, n], the step at which a UAV (row) knows the position of another one
            (column), -1 for never.
        place: float32 [envs, n, n, 3], the positions, cells.
        near, hears: see `CellMessages.pass_on`.
        chosen: bool [envs, n, n], which of the new positions a UAV (row) says; None for all.
        size: bytes of a message about a position.

    Returns:
        int64 [envs, n], the bytes that each UAV said.
    """
    # [envs, hearers, speakers, known]
    newer = near.unsqueeze(-1) & (stamp.unsqueeze(1) > stamp.unsqueeze(2))
    said = newer.any(1) if chosen is None else chosen
    newer &= hears.unsqueeze(-1) & said.unsqueeze(1)
    told, speaker = torch.where(newer, stamp.unsqueeze(1), -1).max(2)
    better = (told > stamp).unsqueeze(-1)
    theirs = place.gather(1, speaker.unsqueeze(-1).expand(*speaker.shape, 3))
    place.copy_(torch.where(better, theirs, place))
    stamp.copy_(torch.maximum(stamp, told))
    return size * said.sum(-1)


class CellMessages(nn.Module):
    """Passes on the cells of maps.

    A UAV says a cell if a UAV in range has no look at it, has an older one, or does not know that
    it was seen while it burned. A map holds 4 times the step of the last look plus the cell's state
    then (1 for fire), -1 for never.

    Between UAVs in contact, a cell can be new only if a UAV saw it at this step, was told it at the
    step before by a UAV that others in range did not hear, had no bytes left to say it, or said it
    without being heard. So whole maps are compared only where a UAV was not in range of another one
    at the step before.

    Args:
        envs: number of environments.
        uavs: UAVs per environment.
        area: cells of a map.
        size: bytes of a message about a cell.
    """

    fresh: Tensor
    """bool [envs, uavs, area]: cells that may be new to UAVs in range"""
    heard: Tensor
    """bool [envs, uavs, uavs]: links without losses at the step before"""
    _shift: Tensor

    def __init__(self, envs: int, uavs: int, area: int, size: int):
        super().__init__()
        self.size = size
        self.register_buffer("fresh", torch.zeros(envs, uavs, area, dtype=torch.bool))
        self.register_buffer("heard", torch.zeros(envs, uavs, uavs, dtype=torch.bool))
        self.register_buffer("_shift", own_maps(envs, uavs, area), persistent=False)

    def start_episodes(self, mask: Tensor) -> None:
        """Forgets the contacts in the environments of a mask, bool [envs]."""
        self.heard.masked_fill_(mask[:, None, None], False)

    def saw(self, view: View) -> None:
        """Notes the cells that UAVs see at this step."""
        mark(self.fresh, view.cells + self._shift, view.in_view)

    def compare(self, known: Knowledge, near: Tensor) -> News:
        """Returns the cells that are new to UAVs in range.

        Args:
            near: bool [envs, n, n], whether a UAV (row) is in range of another one (column).
        """
        last, seen = known.last_seen, known.seen_fire
        assert seen is not None
        self._meet(last, seen, near & ~self.heard)
        told = _told(self.fresh, near)
        row, theirs = _heard_by(near, told, last.shape[2])
        new = _is_new(
            (last.take(told)[row], seen.take(told)[row]), (last.take(theirs), seen.take(theirs))
        )
        rows, row = row[new].unique_consecutive(return_inverse=True)
        return News(told[rows], row, theirs[new])

    def _meet(self, last: Tensor, seen: Tensor, met: Tensor) -> None:
        """Notes the cells that are new to a UAV (row) which comes in range of another one."""
        for env, hearer, speaker in zip(
            *(x.split(_COMPARED) for x in met.nonzero(as_tuple=True)), strict=True
        ):
            told = last[env, speaker], seen[env, speaker]
            theirs = last[env, hearer], seen[env, hearer]
            pair, cell = _is_new(told, theirs).nonzero(as_tuple=True)
            self.fresh[env[pair], speaker[pair], cell] = True

    def pass_on(
        self,
        known: Knowledge,
        near: Tensor,
        hears: Tensor,
        news: News,
        chosen: Tensor | None = None,
    ) -> Tensor:
        """Passes on the new cells: updates the maps of the hearers.

        Args:
            near: bool [envs, n, n], whether a UAV (row) is in range of another one (column).
            hears: bool [envs, n, n], the links of `near` on which no message is lost.
            chosen: bool [envs, n, area], which of the new cells a UAV says; None for all.

        Returns:
            int64 [envs, n], the bytes that each UAV said.
        """
        last, seen = known.last_seen, known.seen_fire
        assert seen is not None
        told, row, theirs = news
        area, fresh, uavs = last.shape[2], self.fresh.view(-1), near.shape[1]
        speaker = told // area
        fresh.zero_()
        said = speaker
        if chosen is not None:
            says = chosen.take(told)
            fresh[told[~says]] = True
            goes, said = says[row], speaker[says]
            row, theirs = row[goes], theirs[goes]
        link = theirs // area * uavs + (speaker % uavs)[row]
        if near is not hears:
            arrives = hears.take(link)
            fresh[told[row[~arrives]]] = True
            row, theirs, link = row[arrives], theirs[arrives], link[arrives]
        last.view(-1).scatter_reduce_(0, theirs, last.take(told)[row], "amax")
        mark(seen, theirs, seen.take(told)[row])
        # Only what somebody in range did not hear from the speaker has to be told again.
        own = torch.eye(uavs, dtype=torch.bool, device=near.device)
        relays = (near.mT.float() @ (~(hears | own)).float()) > 0  # [envs, hearers, speakers]
        fresh[theirs[relays.take(link)]] = True
        self.heard.copy_(near)
        return self.size * said.bincount(minlength=near.shape[:2].numel()).view(near.shape[:2])


def _told(fresh: Tensor, near: Tensor) -> Tensor:
    """Returns the entries that are marked in the maps of UAVs which somebody hears, sorted."""
    area = fresh.shape[2]
    speaker = near.any(1).view(-1).nonzero().squeeze(-1)
    maps = fresh.flatten(0, 1).index_select(0, speaker).flatten()
    # Eight flags are read at a time, as most of them are not set.
    eights = nn.functional.pad(maps, (0, -len(maps) % 8)).view(-1, 8)
    some = eights.view(torch.int64).squeeze(-1).nonzero().squeeze(-1)
    at = (8 * some.unsqueeze(-1) + torch.arange(8, device=maps.device))[eights[some]]
    return speaker.take(at // area) * area + at % area


def _heard_by(near: Tensor, told: Tensor, area: int) -> tuple[Tensor, Tensor]:
    """Returns, for each hearer of an entry in `told`, the index into `told` and its own entry."""
    _, speaker, hearer = near.transpose(1, 2).nonzero(as_tuple=True)
    shift = (hearer - speaker) * area
    count = near.sum(1).view(-1)
    first, count = ((x.take(told // area)) for x in (count.cumsum(0) - count, count))
    row = torch.arange(len(told), device=told.device).repeat_interleave(count)
    link = torch.arange(len(row), device=row.device) - (count.cumsum(0) - count - first).take(row)
    return row, told.take(row) + shift.take(link)


def _is_new(told: tuple[Tensor, Tensor], theirs: tuple[Tensor, Tensor]) -> Tensor:
    """Returns whether a look, (map, seen fire), is newer or the first one in flames."""
    return (told[0] > theirs[0]) | (told[1] > theirs[1])


class Offers(NamedTuple):
    """The new cells of UAVs by falling gain: int64 [envs, n, k] each."""

    gain: Tensor
    """steps by which hearers' looks get newer, see `offers`; 0 behind the last cell"""
    cell: Tensor


def offers(known: Knowledge, news: News, most: int) -> Offers:
    """Returns the new cells of the highest gain, at most `most` for each UAV.

    The gain of a cell is the sum, over the UAVs in range, of the steps by which their last look
    gets newer, at most `OLD` each. A UAV that has not looked, or that does not know that the cell
    was seen while it burned, counts as one that looked at step -1. Of equal gain, the cells that a
    UAV offers first depend on its number, so that UAVs offer different ones.
    """
    last, seen = known.last_seen, known.seen_fire
    assert seen is not None
    told, entry, theirs = news
    envs, uavs, area = last.shape
    fire_is_new = seen.take(told)[entry] & ~seen.take(theirs)
    before = torch.where(fire_is_new, -1, last.take(theirs).long() >> 2)
    newer = ((last.take(told)[entry].long() >> 2) - before).clamp(max=OLD)
    gain = torch.zeros_like(told).index_add_(0, entry, newer)
    row, cell, highest = told // area, told % area, uavs * OLD
    turned = (cell + row % uavs * (area // uavs)) % area
    order = ((row * highest + highest - gain) * area + turned).argsort()
    count = row.bincount(minlength=envs * uavs)  # the rows ascend, and sorting does not move them
    rank = torch.arange(len(row), device=row.device) - (count.cumsum(0) - count)[row]
    best = rank < most
    place, first = (row[best], rank[best]), order[best]
    result = Offers(*told.new_zeros(2, envs * uavs, min(most, int(count.max()))))
    result.gain[place], result.cell[place] = gain[first], cell[first]
    return Offers(*(x.unflatten(0, (envs, uavs)) for x in result))


def place_gain(stamp: Tensor, near: Tensor) -> Tensor:
    """Returns the steps by which positions get newer, summed over hearers, int64 [envs, n, n]."""
    # [envs, hearers, speakers, known]
    newer = (stamp.unsqueeze(1) - stamp.unsqueeze(2)).clamp(min=0)
    return (newer * near.unsqueeze(-1)).sum(1)


def said_within(
    limit: int, cells: Offers, places: Tensor, area: int, sizes: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """Returns which cells and positions UAVs say in a step.

    The highest gain is said first, until the next one does not fit. If that is a position, cells
    fill the bytes that are left. Of equal gain, cells come before positions.

    Args:
        limit: bytes of a UAV.
        cells: the new cells, at least as many as fit into `limit`.
        places: int64 [envs, n, n], from `place_gain`, 0 for a position that is not new.
        sizes: bytes of a cell and of a position.

    Returns:
        Masks of the cells and positions said, bool [envs, n, area] and [envs, n, n].
    """
    cell, place = sizes
    uavs = torch.arange(area, area + places.shape[-1], device=places.device)
    index = torch.cat((cells.cell, uavs.expand_as(places)), -1)
    gain, order = torch.cat((cells.gain, places), -1).sort(stable=True, descending=True)
    index = index.gather(-1, order)
    is_place, is_cell = (gain > 0) & (index >= area), (gain > 0) & (index < area)
    is_place &= (place * is_place + cell * is_cell).cumsum(-1) <= limit
    left = limit - place * is_place.sum(-1, keepdim=True)
    is_cell &= cell * is_cell.cumsum(-1) <= left
    # Cells that are not said are written behind the last entry.
    entries = area + len(uavs)
    index = torch.where(is_place | is_cell, index, entries)
    shape = *gain.shape[:2], entries + 1
    said = torch.zeros(shape, dtype=torch.bool, device=gain.device).scatter_(-1, index, True)
    return said[..., :area], said[..., area:entries]
