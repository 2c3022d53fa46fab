"""Passes on maps and positions: what UAVs say, what it costs, and who knows it afterwards."""

import torch
from torch import Tensor

from emberlink.envs.utils.buffers import Buffers
from emberlink.envs.world.coverage_map import View
from emberlink.envs.world.knowledge import Knowledge

_COMPARED = 2**11
"""pairs of maps that are compared at a time"""

News = tuple[Tensor, ...]
"""environment, speaker, hearer and cell, int64 [k] each, of what is new to a UAV in range"""


def cell_bytes(area: int, horizon: int) -> int:
    """Returns the bytes of a message about a cell.

    They hold the index of the cell, the step of the last look, and what was seen (1 byte).
    """
    return bytes_of(area) + bytes_of(horizon + 1) + 1


def place_bytes(horizon: int) -> int:
    """Returns the bytes of a message about a position.

    They hold a UAV (2 bytes), a step, and three float32 numbers.
    """
    return 2 + bytes_of(horizon + 1) + 12


def bytes_of(count: int) -> int:
    """Returns the bytes of one of `count` numbers: 2, or 4 if there are more than 65,536."""
    return 2 if count <= 2**16 else 4


def worth_of_places(stamp: Tensor, near: Tensor) -> Tensor:
    """Returns what it is worth to say positions: the steps by which they get newer.

    Args:
        stamp, near: see `pass_on_places`.

    Returns:
        int64 [envs, n, n], summed over the UAVs in range of the speaker (row).
    """
    # [envs, hearers, speakers, known]
    gained = (stamp.unsqueeze(1) - stamp.unsqueeze(2)).clamp(min=0)
    return (gained * near.unsqueeze(-1)).sum(1)


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

    A UAV says a cell if one of those in range has an older look at it or none, or does not know
    that it was seen while it burned. A map holds 4 times the step of the last look plus what was
    seen (1 for fire), -1 for never.

    Between UAVs in contact, only cells can be new that a UAV saw at this step, was told at the step
    before, had no time to say, or said in vain. So whole maps are compared only where a UAV was not
    in range of another one at the step before.

    Args:
        envs: number of environments.
        uavs: UAVs per environment.
        area: cells of a map.
        size: bytes of a message about a cell.
    """

    fresh: Tensor
    """bool [envs, uavs, area]: cells that may be new to UAVs in range at the step before"""
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
        news = self._news(last, seen, near & self.heard)
        maps = _differences(last, seen, near & ~self.heard)
        return tuple(torch.cat(parts) for parts in zip(news, maps, strict=True))

    def worth(self, known: Knowledge, near: Tensor, news: News | None) -> tuple[Tensor, Tensor]:
        """Returns what it is worth to say cells: the steps by which the last looks get newer.

        It is at least 1 for each UAV to which something is new, and summed over those in range of
        the speaker.

        Args:
            known, near: see `pass_on`.
            news: what `compare` returned.

        Returns:
            The worth, 0 for nothing new, and the indices of the cells, int64 [envs, n, k] each.
        """
        last, seen = known.last_seen, known.seen_fire
        assert seen is not None
        if news is None:
            return _worth_dense(last, seen, near)
        env, speaker, hearer, cell = news
        shape = envs, uavs, area = last.shape
        entry = (env * uavs + speaker) * area + cell
        entry, number = entry.unique(return_inverse=True)
        gained = _gained(last[env, speaker, cell], last[env, hearer, cell])
        worth = torch.zeros_like(entry).index_add_(0, number, gained)
        row = entry // area
        count = row.bincount(minlength=envs * uavs)
        place = torch.arange(len(entry)) - (count.cumsum(0) - count)[row]
        columns = torch.zeros(2, envs * uavs, int(count.max()), dtype=torch.int64)
        columns[0, row, place], columns[1, row, place] = worth, entry % area
        columns = columns.view(2, *shape[:2], -1)
        return columns[0], columns[1]

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
        env, speaker, hearer, cell = news
        said = torch.zeros_like(seen)
        said[env, speaker, cell] = True
        self.fresh.zero_()
        if chosen is not None:
            self.fresh.copy_(said & ~chosen)
            said, kept = chosen, chosen[env, speaker, cell]
            env, speaker, hearer, cell = (x[kept] for x in (env, speaker, hearer, cell))
        if near is not hears:
            arrives = hears[env, hearer, speaker]
            self.fresh[env[~arrives], speaker[~arrives], cell[~arrives]] = True
            env, speaker, hearer, cell = (x[arrives] for x in (env, speaker, hearer, cell))
        number, was_fire = last[env, speaker, cell], seen[env, speaker, cell]
        place = (env * last.shape[1] + hearer) * last.shape[2] + cell
        last.view(-1).scatter_reduce_(0, place, number, "amax")
        flat = seen.view(-1).view(torch.uint8)
        flat.scatter_reduce_(0, place, was_fire.view(torch.uint8), "amax")
        self.fresh.view(-1)[place] = True
        self.heard.copy_(near)
        return self.size * said.sum(-1)

    def _news(self, last: Tensor, seen: Tensor, near: Tensor) -> News:
        """Returns the fresh cells that are new to others; see `_differences`."""
        env, speaker, cell = self.fresh.nonzero(as_tuple=True)
        linked = near.transpose(1, 2)[env, speaker]
        rows = linked.any(-1)
        env, speaker, cell = env[rows], speaker[rows], cell[rows]
        newer = last[env, speaker, cell].unsqueeze(-1) > last[env, :, cell]
        newer |= seen[env, speaker, cell].unsqueeze(-1) > seen[env, :, cell]
        entry, hearer = (newer & linked[rows]).nonzero(as_tuple=True)
        return env[entry], speaker[entry], hearer, cell[entry]


def _differences(last: Tensor, seen: Tensor, near: Tensor) -> News:
    """Returns environment, speaker, hearer and cell, int64 [k] each, of all cells new to a hearer.

    Args:
        last: integers [envs, n, area].
        seen: bool [envs, n, area].
        near: bool [envs, n, n], whose maps are compared.
    """
    parts = []
    for env, hearer, speaker in zip(
        *(x.split(_COMPARED) for x in near.nonzero(as_tuple=True)), strict=True
    ):
        newer = last[env, speaker] > last[env, hearer]
        newer |= seen[env, speaker] > seen[env, hearer]
        pair, cell = newer.nonzero(as_tuple=True)
        parts.append((env[pair], speaker[pair], hearer[pair], cell))
    return tuple(torch.cat(every) for every in zip(*parts, strict=True))


def _gained(told: Tensor, before: Tensor) -> Tensor:
    """Returns the steps by which looks are newer than before, int64, at least 1."""
    return ((told >> 2).long() - (before >> 2).long()).clamp(min=1)


def _newer(last: Tensor, seen: Tensor, near: Tensor, speaker: int) -> Tensor:
    """Returns what a UAV could tell the others in range, bool [envs, n, area]."""
    told, told_seen = last[:, speaker : speaker + 1], seen[:, speaker : speaker + 1]
    return near[:, :, speaker].unsqueeze(-1) & ((told > last) | (told_seen > seen))


def _worth_dense(last: Tensor, seen: Tensor, near: Tensor) -> tuple[Tensor, Tensor]:
    """Computes `CellMessages.worth` from all maps, and never waits for the device."""
    uavs = range(near.shape[1])
    every = (
        (_gained(last[:, uav : uav + 1], last) * _newer(last, seen, near, uav)).sum(1)
        for uav in uavs
    )
    worth = torch.stack(list(every), 1)
    return worth, torch.arange(last.shape[-1], device=last.device).expand_as(worth)


def _pass_on_dense(
    last: Tensor, seen: Tensor, near: Tensor, hears: Tensor, chosen: Tensor | None
) -> Tensor:
    """Compares all maps, never waits for the device, and returns the number of cells said."""
    before, before_seen, counts = last.clone(), seen.clone(), []
    for uav in range(hears.shape[1]):
        said = _newer(before, before_seen, near, uav).any(1) if chosen is None else chosen[:, uav]
        heard = hears[:, :, uav].unsqueeze(-1) & said.unsqueeze(1)
        told, told_seen = before[:, uav : uav + 1], before_seen[:, uav : uav + 1]
        torch.maximum(last, torch.where(heard, told, -1), out=last)
        seen |= heard & told_seen
        counts.append(said.sum(-1))
    return torch.stack(counts, -1)
