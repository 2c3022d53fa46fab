"""Counts the burning cells of many fires at any step."""

import torch
from torch import Tensor

from emberlink.envs.utils.buffers import Buffers

_CHUNK = 2**22  # cells sorted at a time


class BurningCounts(Buffers):
    """Counts the burning cells of a fire at a step by binary search.

    The table has one entry for each fire and step at which a cell ignites, so its size is at most
    the number of cells and does not depend on the horizon.

    Args:
        fires: arrival times in steps, float32 [fires, X, Y]; inf for cells that never burn.
        horizon: steps of an episode.
    """

    _ignition: Tensor
    _total: Tensor

    def __init__(self, fires: Tensor, horizon: int):
        super().__init__()
        self._horizon, self._cells = horizon, fires[0].numel()
        tables = []
        for first in range(0, len(fires), max(1, _CHUNK // self._cells)):
            chunk = fires[first : first + max(1, _CHUNK // self._cells)].flatten(1)
            step = chunk.ceil().clamp(0, horizon + 1).long()
            fire = torch.arange(first, first + len(chunk), device=fires.device).unsqueeze(-1)
            tables.append(self._entry(fire, step).unique(return_counts=True))
        ignition, counts = (torch.cat(parts) for parts in zip(*tables, strict=True))
        total = torch.cat((counts.new_zeros(1), counts.cumsum(0)))
        self.register_buffer("_ignition", ignition, persistent=False)
        self.register_buffer("_total", total, persistent=False)

    def _entry(self, fire: Tensor, step: Tensor) -> Tensor:
        """Returns integers that sort by fire first and by step second."""
        return fire * (self._horizon + 2) + step

    def at(self, fire: Tensor, step: Tensor) -> Tensor:
        """Returns the number of cells of a fire that burn at a step, int64 [...].

        Args:
            fire: int64 [...], indices of fires.
            step: int64 [...]; steps after the horizon count as the horizon.
        """
        entry = self._entry(fire, step.clamp(max=self._horizon))
        before = torch.searchsorted(self._ignition, entry, right=True)
        return self._total.take(before) - fire * self._cells
