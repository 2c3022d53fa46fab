"""Notices the first number of a training that is not finite, without waiting for the device.

Everything here is a tensor operation on the device, so that it is part of a recorded graph. From
the moment that something was found, the learner changes nothing any more, whenever the host looks.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

NOTHING, COLLECTED, LEARNT, WEIGHTS, CARRIED = range(5)
"""where something was found: in a collected step, in losses and gradients, in what they made; in
what the next step begins with, which is looked at before it is saved"""


class Watch:
    """What a training looks like where it is no longer one.

    Finite means here that the sum of a tensor's squares is: Adam squares gradients.

    Args:
        trained: the networks' tensors by name, one row per UAV of all teams.
    """

    def __init__(self, trained: Mapping[str, Tensor]):
        self.trained = dict(trained)
        self._tensors = list(trained.values())
        device = self._tensors[0].device
        self.bad = torch.zeros((), device=device)
        """1 from when something was found, else 0; Adam skips a step where its `found_inf` is 1"""
        self.found = torch.zeros(3, dtype=torch.int64, device=device)
        """where, and the steps and updates that were good before it"""
        self._place, self._steps, self._updates = self.found.unbind()
        self.batch: TensorDictBase | None = None
        """of the first bad update; of the newest before there is one"""
        self.losses: Tensor | None = None
        """of the same, [2, uavs]: actors, critics"""
        self.gradients: Tensor | None = None
        """their norms in the same, [tensors, uavs]"""
        self.own: Tensor | None = None
        """bool [environments, uavs of a team]: whose observation was not finite before the UAVs
        communicated"""
        self._arriving: tuple[Any, Tensor] | None = None

    def share(self, of: float) -> Tensor:
        """A share, float64 []; 0 from when something was found."""
        return (1 - self.bad).double() * of

    def heard(self, observation: Tensor) -> None:
        """The UAVs' own observations, [environments, uavs, features], before they communicate."""
        wrong = ~observation.isfinite().all(-1)
        if self.own is None:
            self.own = torch.zeros_like(wrong)
        self.own.logical_or_(wrong & (self.bad == 0))

    def collected(self, rows: TensorDictBase) -> None:
        """A step, as it is remembered."""
        values = [one for one in rows.values(True, True) if one.is_floating_point()]
        self._flag(torch.stack([torch.linalg.vector_norm(value) for value in values]), COLLECTED)
        self._steps.add_(self.bad == 0)

    def drawn(self, batch: TensorDictBase) -> None:
        """What an update is about to learn from."""
        if self.batch is None or self.batch.shape != batch.shape:
            self.batch = batch.clone()
            return
        for key, place in self.batch.items(True, True):
            self._keep(place, batch.get(key))

    def learnt(self, losses: Tensor) -> None:
        """An update's losses, [2, uavs], and the gradients that are there now."""
        gradients = norms([one.grad for one in self._tensors if one.grad is not None])
        if self.losses is None or self.gradients is None:
            self.losses, self.gradients = losses.clone(), gradients.clone()
        else:
            self._keep(self.losses, losses)
            self._keep(self.gradients, gradients)
        self._flag(torch.cat((losses, gradients)), LEARNT)

    def updated(self) -> None:
        """The networks have made their step."""
        self._flag(norms(self._tensors), WEIGHTS)
        self._updates.add_(self.bad == 0)

    def look(self, *, wait: bool = False) -> bool:
        """Whether something was found: by now, or on a GPU as far as it has got word of.

        Args:
            wait: by now on a GPU as well, for which it is waited.
        """
        if wait or not self.bad.is_cuda:
            return bool(self.bad)
        if self._arriving is None:
            self._arriving = self._send()
        event, arrived = self._arriving
        if not event.query():  # on its way, and nothing is waited for
            return False
        self._arriving = None
        return bool(arrived)

    def _send(self) -> tuple[Any, Tensor]:
        with torch.cuda.device(self.bad.device):
            arriving = torch.empty((), pin_memory=True)
            arriving.copy_(self.bad, non_blocking=True)
            event = torch.cuda.Event()
            event.record()
        return event, arriving

    def _keep(self, place: Tensor, value: Tensor) -> None:
        """Writes a value, unless something was found before."""
        place.copy_(torch.where(self.bad > 0, place, value))

    def _flag(self, values: Tensor, place: int) -> None:
        wrong = ~values.isfinite().all()
        self._place.masked_fill_(wrong & (self.bad == 0), place)
        self.bad.masked_fill_(wrong, 1.0)


def norms(tensors: Sequence[Tensor]) -> Tensor:
    """The Euclidean norm of each UAV's part of each tensor [uavs, ...]: [tensors, uavs]."""
    if tensors[0].is_cuda:  # a few launches for all, where a CPU is faster one after another
        parts = [part for one in tensors for part in one.detach().unbind(0)]
        return torch.stack(torch._foreach_norm(parts)).view(len(tensors), -1)  # pyright: ignore[reportPrivateImportUsage]
    return torch.stack([torch.linalg.vector_norm(one.detach(), dim=(1, 2)) for one in tensors])
