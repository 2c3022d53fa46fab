"""Passes on maps and positions: what UAVs say, what it costs, and who knows it afterwards."""

from typing import NamedTuple

import torch
from torch import Tensor

from emberlink.envs.utils.buffers import Buffers
from emberlink.envs.world.coverage_map import View
from emberlink.envs.world.knowledge import Knowledge

_COMPARED = 2**11
"""pairs of maps that are compared at a time"""


class News(NamedTuple):
    """The cells that are new to UAVs in range of the speaker.

    Entries of maps, [envs, n, area], are given by their index in the flat array.
    """

    told: Tensor
    """int64 [k], the entries of the speakers; ascend"""
    row: Tensor
    """int64 [m], which of these is new to a UAV in range; ascends"""
    theirs: Tensor
    """int64 [m], the entry of the UAV to which it is new"""


def cell_bytes(horizon: int) -> int:
    """Returns the bytes of a message about a cell.

    They hold the index of the cell (2 bytes), the step of the last look, and what was seen (1
    byte).
    """
    return 2 + _bytes_of_step(horizon) + 1


def place_bytes(horizon: int) -> int:
    """Returns the bytes of a message about a position.

    They hold a UAV (2 bytes), a step, and three float32 numbers.
    """
    return 2 + _bytes_of_step(horizon) + 12


def _bytes_of_step(horizon: int) -> int:
    return 2 if horizon < 2**16 else 4


def pass_on_places(
    stamp: Tensor, place: Tensor, near: Tensor, hears: Tensor, chosen: Tensor | None, size: int
) -> Tensor:
    """Passes on the positions that UAVs know of each other, in place.

    A UAV says a position if one of those in range knows an older one or none.

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


class CellMessages(Buffers):
    """Passes on the cells of maps.

    A UAV says a cell if a UAV in range has no look at it, has an older one, or does not know that
    it was seen while it burned. A map holds 4 times the step of the last look plus what was
    seen (1 for fire), -1 for never.

    Between UAVs in contact, a cell can be new only if a UAV saw it at this step, was told it at the
    step before, had no bytes left to say it, or said it without being heard. So whole maps are
    compared only where a UAV was not in range of another one at the step before.

    Args:
        envs: number of environments.
        uavs: UAVs per environment.
        area: cells of a map.
        size: bytes of a message about a cell.
    """

    fresh: Tensor
    """bool [envs, uavs, area]: cells that may be new to UAVs in range; not read on a GPU"""
    heard: Tensor
    """bool [envs, uavs, uavs]: whom each UAV was in range of at the step before"""
    _shift: Tensor

    def __init__(self, envs: int, uavs: int, area: int, size: int):
        super().__init__()
        self.size = size
        self.register_buffer("fresh", torch.zeros(envs, uavs, area, dtype=torch.bool))
        self.register_buffer("heard", torch.zeros(envs, uavs, uavs, dtype=torch.bool))
        # A view's cell of environment e is at e * area; the map of a UAV begins at
        # (e * uavs + uav) * area.
        maps = torch.arange(envs * uavs).view(envs, uavs, 1)
        shift = maps - torch.arange(envs).view(-1, 1, 1)
        self.register_buffer("_shift", shift * area, persistent=False)

    def start_episodes(self, mask: Tensor) -> None:
        """Forgets the contacts in the environments of a mask, bool [envs]."""
        self.heard.masked_fill_(mask[:, None, None], False)

    def saw(self, view: View) -> None:
        """Notes the cells that UAVs see at this step."""
        index = (view.cells + self._shift).flatten()
        flat = self.fresh.view(-1).view(torch.uint8)
        flat.scatter_reduce_(0, index, view.in_view.flatten().view(torch.uint8), "amax")

    def compare(self, known: Knowledge, near: Tensor) -> News | None:
        """Returns what is new to UAVs in range; None on a GPU, which would have to wait for it.

        Args:
            known: the maps.
            near: bool [envs, n, n], whether a UAV (row) is in range of another one (column).
        """
        last, seen = known.last_seen, known.seen_fire
        assert seen is not None
        if last.is_cuda:
            return None
        self._meet(last, seen, near & ~self.heard)
        told = self.fresh.view(-1).nonzero().squeeze(-1)
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
        news: News | None,
        chosen: Tensor | None = None,
    ) -> Tensor:
        """Changes the maps of those that hear others.

        Args:
            known: the maps.
            near: bool [envs, n, n], whether a UAV (row) is in range of another one (column).
            hears: bool [envs, n, n], of these, who hears the other one: no message is lost.
            news: what `compare` returned.
            chosen: bool [envs, n, area], which of the new cells a UAV says; None for all.

        Returns:
            int64 [envs, n], the bytes that each UAV said.
        """
        last, seen = known.last_seen, known.seen_fire
        assert seen is not None
        if news is None:
            self.heard.zero_()
            return self.size * _pass_on_dense(last, seen, near, hears, chosen)
        told, row, theirs = news
        area, fresh = last.shape[2], self.fresh.view(-1)
        speaker = told // area
        fresh.zero_()
        said = speaker
        if chosen is not None:
            says = chosen.take(told)
            fresh[told[~says]] = True
            goes, said = says[row], speaker[says]
            row, theirs = row[goes], theirs[goes]
        if near is not hears:
            uavs = near.shape[1]
            arrives = hears.take(theirs // area * uavs + (speaker % uavs)[row])
            fresh[told[row[~arrives]]] = True
            row, theirs = row[arrives], theirs[arrives]
        last.view(-1).scatter_reduce_(0, theirs, last.take(told)[row], "amax")
        was_fire, flat = seen.take(told).view(torch.uint8)[row], seen.view(-1).view(torch.uint8)
        flat.scatter_reduce_(0, theirs, was_fire, "amax")
        fresh[theirs] = True
        self.heard.copy_(near)
        return self.size * said.bincount(minlength=near.shape[:2].numel()).view(near.shape[:2])


def _heard_by(near: Tensor, told: Tensor, area: int) -> tuple[Tensor, Tensor]:
    """Returns the entries of UAVs that are in range of speakers.

    Args:
        near: bool [envs, n, n], whether a UAV (row) is in range of another one (column).
        told: int64 [k], entries of the speakers, see `News`.
        area: cells of a map.

    Returns:
        For each UAV in range, which of the k entries it can hear, and its entry, int64 [m] each.
    """
    _, speaker, hearer = near.transpose(1, 2).nonzero(as_tuple=True)
    shift = (hearer - speaker) * area
    count = near.sum(1).view(-1)
    first, count = ((x.take(told // area)) for x in (count.cumsum(0) - count, count))
    row = torch.arange(len(told)).repeat_interleave(count)
    link = torch.arange(len(row)) - (count.cumsum(0) - count - first).take(row)
    return row, told.take(row) + shift.take(link)


def _is_new(told: tuple[Tensor, Tensor], theirs: tuple[Tensor, Tensor]) -> Tensor:
    """Returns whether what is told is newer than what others know, or tells of fire new to them.

    Args:
        told, theirs: maps of the speakers and of the others, integers, and whether cells were seen
            while they burned, bool.
    """
    return (told[0] > theirs[0]) | (told[1] > theirs[1])


def could_tell(last: Tensor, seen: Tensor, near: Tensor, speaker: int) -> Tensor:
    """Returns what a UAV could tell the others in range, bool [envs, n, area]."""
    told = last[:, speaker : speaker + 1], seen[:, speaker : speaker + 1]
    return near[:, :, speaker].unsqueeze(-1) & _is_new(told, (last, seen))


def _pass_on_dense(
    last: Tensor, seen: Tensor, near: Tensor, hears: Tensor, chosen: Tensor | None
) -> Tensor:
    """Compares all maps, never waits for the device, and returns the number of cells said."""
    before, before_seen, counts = last.clone(), seen.clone(), []
    for uav in range(hears.shape[1]):
        said = (
            could_tell(before, before_seen, near, uav).any(1) if chosen is None else chosen[:, uav]
        )
        heard = hears[:, :, uav].unsqueeze(-1) & said.unsqueeze(1)
        told, told_seen = before[:, uav : uav + 1], before_seen[:, uav : uav + 1]
        torch.maximum(last, torch.where(heard, told, -1), out=last)
        seen |= heard & told_seen
        counts.append(said.sum(-1))
    return torch.stack(counts, -1)
