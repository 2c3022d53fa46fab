"""Counts the cells of many fires that burn or have burnt at any step."""

import math

import torch
from torch import Tensor

from emberlink.envs.utils.buffers import Buffers

_CHUNK = 2**22  # cells sorted at a time


def split_times(fires: Tensor) -> tuple[Tensor, Tensor | None]:
    """Splits fires into arrival and burn-out times, float32 [fires, X, Y] each.

    A cell burns at a step if `arrival <= step < burn_out`.

    Args:
        fires: steps, [fires, X, Y] of arrival alone, or [fires, 2, X, Y] of arrival and burn-out.

    Returns:
        The arrival times, and the burn-out times or None if cells burn for ever.
    """
    return (fires, None) if fires.ndim == 3 else (fires[:, 0], fires[:, 1])


def with_burn_time(arrival: Tensor, burn_time: float) -> Tensor:
    """Returns fires whose cells burn for `burn_time` steps each; `arrival` itself if it is inf.

    Args:
        arrival: arrival times in steps, float32 [fires, X, Y].
        burn_time: steps, at least 1.

    Returns:
        Arrival and burn-out times, float32 [fires, 2, X, Y], or `arrival`.
    """
    if math.isinf(burn_time):
        return arrival
    return torch.stack((arrival, arrival + burn_time), 1)


class PassedCounts(Buffers):
    """Counts the cells of a fire whose time has passed at a step by binary search.

    The table has one entry for each fire and step at which the time of a cell passes. Its size is
    at most the number of cells and does not depend on the horizon.

    Args:
        times: arrival or burn-out times in steps, float32 [fires, X, Y]; inf for never.
        horizon: steps of an episode.
    """

    _step: Tensor
    _total: Tensor

    def __init__(self, times: Tensor, horizon: int):
        super().__init__()
        self._horizon, self._cells = horizon, times[0].numel()
        tables = []
        for first in range(0, len(times), max(1, _CHUNK // self._cells)):
            chunk = times[first : first + max(1, _CHUNK // self._cells)].flatten(1)
            step = chunk.ceil().clamp(0, horizon + 1).long()
            fire = torch.arange(first, first + len(chunk), device=times.device).unsqueeze(-1)
            tables.append(self._entry(fire, step).unique(return_counts=True))
        steps, counts = (torch.cat(parts) for parts in zip(*tables, strict=True))
        total = torch.cat((counts.new_zeros(1), counts.cumsum(0)))
        self.register_buffer("_step", steps, persistent=False)
        self.register_buffer("_total", total, persistent=False)

    def _entry(self, fire: Tensor, step: Tensor) -> Tensor:
        """Returns integers that sort by fire first and by step second."""
        return fire * (self._horizon + 2) + step

    def at(self, fire: Tensor, step: Tensor) -> Tensor:
        """Returns the number of cells of a fire with `time <= step`, int64 [...].

        Args:
            fire: int64 [...], indices of fires.
            step: int64 [...]; steps after the horizon count as the horizon.
        """
        entry = self._entry(fire, step.clamp(max=self._horizon))
        before = torch.searchsorted(self._step, entry, right=True)
        return self._total.take(before) - fire * self._cells
