"""What burns, and who saw it first: the maps of all environments side by side."""

import torch
from torch import Tensor

from emberlink.envs.fire.generator import burning_cells
from emberlink.envs.utils.buffers import Buffers

from .sensor import View

_NEVER = torch.iinfo(torch.int32).max


class Discovery(Buffers):
    """The fire of every environment, and what its UAVs have seen of it.

    UAV 0 looks first: a cell is new to the lowest UAV that sees it at the first step at which
    anyone does, and old to all others from then on. A sighting is written down as one number,
    step * uavs + UAV, of which the smallest settles that without a loop over UAVs.

    Args:
        view: what a window is.
        fires: arrival times in steps, float32 [fires, X, Y], inf where it never burns.
        horizon: steps of an episode.
        envs: environments side by side.
        uavs: in each.
    """

    _fires: Tensor
    _growth: Tensor
    _start: Tensor
    _uav: Tensor
    _never: Tensor
    _arrival: Tensor
    _growth_start: Tensor
    _first_seen: Tensor
    _stamp: Tensor

    def __init__(self, view: View, fires: Tensor, *, horizon: int, envs: int, uavs: int):
        super().__init__()
        self._view, self._horizon, self._uavs = view, horizon, uavs
        self.register_buffer("_growth", burning_cells(fires, horizon).flatten(), persistent=False)
        # Beyond the edge nothing burns and nothing does not: NaN is neither before nor after now.
        self.register_buffer("_fires", view.pad(fires, torch.nan), persistent=False)
        self.register_buffer(
            "_start", torch.arange(envs).unsqueeze(-1) * view.area, persistent=False
        )
        self.register_buffer(
            "_uav", torch.arange(uavs, dtype=torch.int32).unsqueeze(-1), persistent=False
        )
        self.register_buffer("_never", torch.tensor(_NEVER, dtype=torch.int32), persistent=False)
        self.register_buffer("_arrival", self._fires[:1].repeat(envs, 1))
        self.register_buffer("_growth_start", torch.zeros(envs, dtype=torch.int64))
        first_seen = torch.full((envs, view.area), _NEVER, dtype=torch.int32)
        self.register_buffer("_first_seen", first_seen)
        self.register_buffer("_stamp", self._uav.repeat(envs, 1, 1))

    def __len__(self) -> int:
        """How many fires there are."""
        return len(self._fires)

    @property
    def arrival(self) -> Tensor:
        """The fire of each environment: arrival times in steps, float32 [envs, X, Y]."""
        return self._view.crop(self._arrival)

    @property
    def seen(self) -> Tensor:
        """The burning cells that some UAV has seen, bool [envs, X, Y]."""
        return self._view.crop(self._first_seen < _NEVER)

    def begin(self, mask: Tensor, fire: Tensor) -> None:
        """New episodes: bool [envs] says where, int64 [envs] with which fires."""
        self._arrival.copy_(torch.where(mask[:, None], self._fires[fire], self._arrival))
        first_growth = fire * (self._horizon + 1)
        self._growth_start.copy_(torch.where(mask, first_growth, self._growth_start))
        self._first_seen.masked_fill_(mask[:, None], _NEVER)
        self._stamp.copy_(torch.where(mask[:, None, None], self._uav, self._stamp))

    def burning(self, step: Tensor) -> Tensor:
        """Cells that burn at a step, int64 [envs] both."""
        return self._growth.take(step.clamp(max=self._horizon).add_(self._growth_start))

    def look(self, position: Tensor, step: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """All UAVs look at once, one step after they did last.

        Args:
            position: float64 [envs, uavs, 3], cells.
            step: of this look, float32 [envs].

        Returns:
            Cells in view that are new fire, old fire and no fire: how many, float64
            [envs, uavs, 3], their mean (i, j), float32 [envs, uavs, 3, 2], and which cells of the
            window they are, bool [envs, uavs, 3, W * W].
        """
        centre, cells, near = self._view.look(position, self._start)
        stamp, first_seen, now = self._stamp, self._first_seen, step.view(-1, 1, 1)
        stamp.add_(self._uavs)
        arrival = self._arrival.take(cells)
        burning = near & (arrival <= now)
        claims = torch.where(burning, stamp, self._never)
        first_seen.view(-1).scatter_reduce_(0, cells.view(-1), claims.view(-1), "amin")
        new = first_seen.take(cells) == stamp
        classes = torch.stack((new, burning ^ new, near & (arrival > now)), -2)
        return *self._view.tally(classes, centre), classes
