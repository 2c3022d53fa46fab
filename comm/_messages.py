"""Passes on maps and positions: what UAVs say, what it costs, and who knows it afterwards."""

import torch
from torch import Tensor

from emberlink.envs.utils.buffers import Buffers
from emberlink.envs.world.coverage_map import View
from emberlink.envs.world.knowledge import Knowledge

_COMPARED = 2**11
"""pairs of maps that are compared at a time"""


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


def pass_on_places(
    stamp: Tensor, place: Tensor, near: Tensor, hears: Tensor, left: Tensor | None, size: int
) -> Tensor:
    """Passes on the positions that UAVs know of each other, in place.

    A UAV says a position if one of those in range knows an older one or none. With a limit, the
    newest are said first.

    Args:
        stamp: int64 [envs, n, n], the step at which a UAV (row) knows the position of another one
            (column), -1 for never.
        place: float32 [envs, n, n, 3], the positions, cells.
        near, hears: see `CellMessages.pass_on`.
        left: int64 [envs, n], the bytes that each UAV can still say; None for no limit.
        size: bytes of a message about a position.

    Returns:
        int64 [envs, n], the bytes that each UAV said.
    """
    # [envs, hearers, speakers, known]
    newer = near.unsqueeze(-1) & (stamp.unsqueeze(1) > stamp.unsqueeze(2))
    said = newer.any(1)
    if left is not None:
        uavs = stamp.shape[-1]
        worth = stamp * uavs + torch.arange(uavs, device=stamp.device)
        said = keep_best(said, worth, left // size, uavs)
    newer &= hears.unsqueeze(-1) & said.unsqueeze(1)
    told, speaker = torch.where(newer, stamp.unsqueeze(1), -1).max(2)
    better = (told > stamp).unsqueeze(-1)
    theirs = place.gather(1, speaker.unsqueeze(-1).expand(*speaker.shape, 3))
    place.copy_(torch.where(better, theirs, place))
    stamp.copy_(torch.maximum(stamp, told))
    return size * said.sum(-1)


def keep_best(said: Tensor, worth: Tensor, allowed: Tensor, most: int) -> Tensor:
    """Returns the most useful entries of a mask, bool [..., entries].

    Args:
        said: bool [..., entries].
        worth: int64 [..., entries], at least 0 where `said` is true; no two are equal.
        allowed: int64 [...], number of entries to keep.
        most: the largest number in `allowed`, or a larger one.
    """
    most = min(most, said.shape[-1])
    if not most:
        return torch.zeros_like(said)
    best, place = torch.where(said, worth, -1).topk(most, -1)
    rank = torch.arange(most, device=said.device)
    kept = (best >= 0) & (rank < allowed.unsqueeze(-1))
    return torch.zeros_like(said).scatter_(-1, place, kept)


class CellMessages(Buffers):
    """Passes on the cells of maps.

    A UAV says a cell if one of those in range has an older look at it or none, or does not know
    that it was seen while it burned. With a limit, cells with fire are said first, then the others;
    of each, the newest look first. A map holds 4 times the step of the last look plus what was seen
    (1 for fire), -1 for never.

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

    def pass_on(self, known: Knowledge, near: Tensor, hears: Tensor, limit: int | None) -> Tensor:
        """Changes the maps of those that hear others.

        Args:
            known: the maps.
            near: bool [envs, n, n], whether a UAV (row) is in range of another one (column).
            hears: bool [envs, n, n], of these, who hears the other one: no message is lost.
            limit: bytes that a UAV can say in a step; None for no limit.

        Returns:
            int64 [envs, n], the bytes that each UAV said.
        """
        last, seen = known.last_seen, known.seen_fire
        assert seen is not None
        most = None if limit is None else limit // self.size
        if last.is_cuda:
            self.heard.zero_()
            return self.size * _pass_on_dense(last, seen, near, hears, most)
        news = self._news(last, seen, near & self.heard)
        maps = _differences(last, seen, near & ~self.heard)
        env, speaker, hearer, cell = (torch.cat(parts) for parts in zip(news, maps, strict=True))
        said = torch.zeros_like(seen)
        said[env, speaker, cell] = True
        self.fresh.zero_()
        if most is not None:
            over = said.sum(-1) > most
            wanted, said[over] = said.clone(), _best(said[over], last[over], most)
            self.fresh.copy_(wanted & ~said)
            kept = said[env, speaker, cell]
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

    def _news(self, last: Tensor, seen: Tensor, near: Tensor) -> tuple[Tensor, ...]:
        """Returns the fresh cells that are new to others; see `_differences`."""
        env, speaker, cell = self.fresh.nonzero(as_tuple=True)
        linked = near.transpose(1, 2)[env, speaker]
        rows = linked.any(-1)
        env, speaker, cell = env[rows], speaker[rows], cell[rows]
        newer = last[env, speaker, cell].unsqueeze(-1) > last[env, :, cell]
        newer |= seen[env, speaker, cell].unsqueeze(-1) > seen[env, :, cell]
        entry, hearer = (newer & linked[rows]).nonzero(as_tuple=True)
        return env[entry], speaker[entry], hearer, cell[entry]


def _differences(last: Tensor, seen: Tensor, near: Tensor) -> tuple[Tensor, ...]:
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


def _best(said: Tensor, last: Tensor, most: int) -> Tensor:
    """Returns the `most` most useful cells of `said`, bool [..., area]."""
    area = last.shape[-1]
    number = last.long()
    fire = (number & 3 == 1) & (number >= 0)
    worth = (number + fire * 2**32) * area + torch.arange(area, device=last.device)
    return keep_best(said, worth, torch.full_like(number[..., 0], most), most)


def _pass_on_dense(
    last: Tensor, seen: Tensor, near: Tensor, hears: Tensor, most: int | None
) -> Tensor:
    """Compares all maps, never waits for the device, and returns the number of cells said.

    A UAV says at most `most` cells; None is no limit.
    """
    before, before_seen, counts = last.clone(), seen.clone(), []
    for number in range(hears.shape[1]):
        told, told_seen = before[:, number : number + 1], before_seen[:, number : number + 1]
        newer = near[:, :, number].unsqueeze(-1) & ((told > before) | (told_seen > before_seen))
        said = newer.any(1)
        if most is not None:
            said = _best(said, told[:, 0], most)
        heard = hears[:, :, number].unsqueeze(-1) & said.unsqueeze(1)
        torch.maximum(last, torch.where(heard, told, -1), out=last)
        seen |= heard & told_seen
        counts.append(said.sum(-1))
    return torch.stack(counts, -1)
