"""Detects the first NaN or Inf in training without synchronising with the device.

All checks are tensor operations, so CUDA graphs can contain them. After a detection, the learner
changes no weights, even if the host reads the flag much later.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

NOTHING, ROLLOUT, UPDATE = range(3)
"""place of the first NaN or Inf"""


class NonFiniteGuard:
    """Flags non-finite rollouts, losses and gradients, and keeps the first of them.

    A tensor counts as finite if the sum of its squares is finite, because Adam squares gradients.

    Args:
        device: device of the training.
    """

    def __init__(self, device: torch.device | str):
        self.bad = torch.zeros((), dtype=torch.float32, device=device)
        """1 after a detection, else 0; Adam skips a step if its `found_inf` is 1"""
        self._counts = torch.zeros(3, dtype=torch.int64, device=device)
        self._place, self._steps, self._updates = self._counts.unbind()
        self._rollouts = _Newest(self.bad)
        self._batches = _Newest(self.bad)
        self.losses: dict[str, Tensor] = {}
        """losses of the first non-finite update; before a detection, of the newest; [uavs] each"""
        self.gradients: dict[str, Tensor] = {}
        """norms of its gradients, one per row of the parameter"""
        self._arriving: tuple[Any, Tensor] | None = None

    @property
    def rollout(self) -> TensorDictBase | None:
        """The first non-finite rollout; before a detection, the newest rollout."""
        return self._rollouts.get()

    @property
    def batch(self) -> TensorDictBase | None:
        """The batch of the first non-finite update; before a detection, of the newest update."""
        return self._batches.get()

    def start(self, steps: int, updates: int) -> None:
        """Sets the number of steps and updates done so far."""
        self._steps.fill_(steps)
        self._updates.fill_(updates)

    def share(self, value: float) -> Tensor:
        """Returns the value, float64 []; 0 after a detection."""
        return (1 - self.bad).double() * value

    def record_rollout(self, rollout: TensorDictBase, steps: int) -> None:
        """Checks and keeps a rollout of the given number of steps."""
        self._rollouts.keep(rollout)
        values = [value for value in rollout.values(True, True) if value.is_floating_point()]
        self._flag(torch.stack([torch.linalg.vector_norm(value) for value in values]), ROLLOUT)
        self._steps.add_((self.bad == 0) * steps)

    def record_batch(self, batch: TensorDictBase) -> None:
        """Keeps the batch of the next update."""
        self._batches.keep(batch)

    def check_gradients(
        self, losses: Mapping[str, Tensor], gradients: Mapping[str, Tensor]
    ) -> None:
        """Checks the losses and gradients of an update and counts the update.

        Args:
            losses: detached losses by name, [uavs] each.
            gradients: gradients by parameter, [rows, ...] each; a row belongs to a UAV or a team.
        """
        norms = dict(zip(gradients, row_norms(list(gradients.values())), strict=True))
        for kept, new in ((self.losses, losses), (self.gradients, norms)):
            for name, value in new.items():
                if name in kept:
                    kept[name].copy_(torch.where(self.bad > 0, kept[name], value))
                else:
                    kept[name] = value.clone()
        self._flag(torch.cat([*losses.values(), *norms.values()]), UPDATE)
        self._updates.add_(self.bad == 0)

    def poll(self, *, wait: bool = False) -> bool:
        """Returns whether a NaN or Inf was detected.

        Args:
            wait: whether to wait for a GPU; if not, the result may be some steps old.
        """
        if wait or not self.bad.is_cuda:
            return bool(self.bad)
        if self._arriving is None:
            self._arriving = self._send()
        event, arrived = self._arriving
        if not event.query():
            return False
        self._arriving = None
        return bool(arrived)

    def found(self) -> tuple[int, int, int]:
        """Returns the place of the detection, and the steps and updates that were finite before."""
        place, steps, updates = self._counts.tolist()
        return place, steps, updates

    def _send(self) -> tuple[Any, Tensor]:
        with torch.cuda.device(self.bad.device):
            arriving = torch.empty((), dtype=torch.float32, pin_memory=True)
            arriving.copy_(self.bad, non_blocking=True)
            event = torch.cuda.Event()
            event.record()
        return event, arriving

    def _flag(self, values: Tensor, place: int) -> None:
        wrong = ~values.isfinite().all()
        self._place.masked_fill_(wrong & (self.bad == 0), place)
        self.bad.masked_fill_(wrong, 1.0)


class _Newest:
    """Keeps the newest of several TensorDicts until a detection.

    There is a copy for each batch size, since the minibatches of an epoch may differ in size.

    Args:
        bad: 1 after a detection, else 0.
    """

    def __init__(self, bad: Tensor):
        self._bad = bad
        self._newest = torch.zeros((), dtype=torch.int64, device=bad.device)
        self._copies: dict[torch.Size, TensorDictBase] = {}

    def keep(self, value: TensorDictBase) -> None:
        """Copies a TensorDict, unless there was a detection before."""
        place = self._copies.get(value.shape)
        if place is None:
            self._copies[value.shape] = value.clone()
        else:
            for key, tensor in place.items(True, True):
                tensor.copy_(torch.where(self._bad > 0, tensor, value.get(key)))
        number = list(self._copies).index(value.shape)
        self._newest.copy_(torch.where(self._bad > 0, self._newest, number))

    def get(self) -> TensorDictBase | None:
        """Returns the newest TensorDict before a detection; waits for a GPU."""
        return list(self._copies.values())[int(self._newest)] if self._copies else None


def row_norms(tensors: Sequence[Tensor]) -> list[Tensor]:
    """Returns the Euclidean norms of the rows of tensors [rows, ...], [rows] each."""
    if tensors and tensors[0].is_cuda:  # few kernel launches; on a CPU, a loop is faster
        rows = [row for tensor in tensors for row in tensor.detach().unbind(0)]
        norms = torch.stack(torch._foreach_norm(rows))  # pyright: ignore[reportPrivateImportUsage]
        return list(norms.split([len(tensor) for tensor in tensors]))
    return [torch.linalg.vector_norm(tensor.detach().flatten(1), dim=1) for tensor in tensors]
