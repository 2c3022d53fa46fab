"""Stores the belief map of each UAV: the last step at which each cell was seen."""

import torch
from torch import Tensor, nn

from emberlink.envs.world import radio
from emberlink.envs.world.coverage_map import View, mark, own_maps

NEVER = -1
"""last step of a cell that was never seen"""


def step_type(horizon: int) -> torch.dtype:
    """Returns the smallest integer type that holds the steps of an episode."""
    return torch.int16 if horizon < torch.iinfo(torch.int16).max else torch.int32


class Knowledge(nn.Module):
    """Stores a map per UAV of the last step at which each cell was seen, by it or by others.

    At each step, a UAV merges into its map the maps of all radios whose messages arrive, directly
    or passed on. The later step of each cell is kept. Since a fire is a function of time, the step
    of the last look gives the cell's state then.

    Two UAVs that stay in contact differ only in the sightings of this step. So whole maps are
    compared only where a message arrives that did not arrive at the step before.

    Args:
        envs: number of environments.
        uavs: UAVs per environment; they are the first radios.
        area: cells of a padded map (`Sensor.area`).
        horizon: steps of an episode.
        listeners: radios that look at nothing, such as a base station, after the UAVs.
        fires: whether to store also which cells were seen while they burned.
    """

    last_seen: Tensor
    """int16 [envs, radios, area] (int32 for long episodes), `NEVER` where nobody looked"""
    seen_fire: Tensor | None
    """bool [envs, radios, area]: whether there is a sighting of the cell while it burned"""
    reach: Tensor
    """bool [envs, radios, radios]: whether messages of a radio (column) arrived at another (row) in
    the last step, directly or passed on"""
    _first: Tensor

    def __init__(
        self,
        *,
        envs: int,
        uavs: int,
        area: int,
        horizon: int,
        listeners: int = 0,
        fires: bool = False,
    ):
        super().__init__()
        shape = envs, uavs + listeners, area
        self.register_buffer("last_seen", torch.full(shape, NEVER, dtype=step_type(horizon)))
        self.register_buffer("seen_fire", torch.zeros(shape, dtype=torch.bool) if fires else None)
        alone = torch.eye(shape[1], dtype=torch.bool)
        self.register_buffer("reach", alone.repeat(envs, 1, 1))
        self.register_buffer("_first", own_maps(envs, shape[1], area), persistent=False)

    def start_episodes(self, mask: Tensor) -> None:
        """Forgets everything in the environments of a mask, bool [envs]."""
        began = mask[:, None, None]
        self.last_seen.masked_fill_(began, NEVER)
        if self.seen_fire is not None:
            self.seen_fire.masked_fill_(began, False)
        alone = torch.eye(self.reach.shape[-1], dtype=torch.bool, device=mask.device)
        self.reach.copy_(torch.where(began, alone, self.reach))

    def see(self, view: View, stored: Tensor) -> None:
        """Adds what each UAV sees to its own map alone.

        Args:
            stored: integers [envs, uavs, cells], the step of each sighting, or a number that is
                larger for later steps.
        """
        index = view.cells + self._first[:, : view.cells.shape[1]]
        values = torch.where(view.in_view, stored, NEVER).to(self.last_seen.dtype)
        self.last_seen.view(-1).scatter_reduce_(0, index.view(-1), values.view(-1), "amax")
        if self.seen_fire is not None:
            mark(self.seen_fire, index, view.burning)

    def update(self, view: View, step: Tensor, hears: Tensor) -> None:
        """Adds the sightings and messages of a step.

        Args:
            step: int64 [envs], steps since the episode began.
            hears: bool [envs, radios, radios], whether a radio (row) hears another one (column).
        """
        reach = radio.reachable(hears)
        uavs = view.cells.shape[1]
        knows = reach[..., :uavs].unsqueeze(-1)
        index = (view.cells.unsqueeze(1) + self._first.unsqueeze(-1)).flatten(1)
        now = step.to(self.last_seen.dtype).view(-1, 1, 1, 1)
        seen = torch.where(knows & view.in_view.unsqueeze(1), now, NEVER).flatten(1)
        self.last_seen.view(-1).scatter_reduce_(0, index.view(-1), seen.view(-1), "amax")
        if self.seen_fire is not None:
            mark(self.seen_fire, index, knows & view.burning.unsqueeze(1))
        self._merge(reach & ~self.reach)
        self.reach.copy_(reach)

    def _merge(self, new: Tensor) -> None:
        """Takes over maps (column) into maps (row) where bool [envs, radios, radios] is true."""
        env, taker, source = new.nonzero(as_tuple=True)
        for number in source.unique().tolist():
            rows = source == number
            where = env[rows], taker[rows]
            for known in (self.last_seen, self.seen_fire):
                if known is not None:
                    known[where] = torch.maximum(known[where], known[env[rows], number])
