"""Draws learned policies towards the policy that they started from."""

import copy
from typing import Any

import torch
from torch import Tensor, nn

from emberlink.envs.utils.errors import UserError


class Anchor:
    """Keeps a frozen copy of actors, whose actions the learned actors may leave at a cost.

    Args:
        network: the actors of all seeds.
        weight: weight of the loss at the beginning; it falls linearly to 0 at the end of the run.
        device: of the weight.
    """

    def __init__(self, network: nn.Module, weight: float, device: torch.device | str):
        self.network: Any = copy.deepcopy(network).requires_grad_(False)
        self._first = weight
        # On the device, where CUDA graphs read its current value.
        self.weight = torch.tensor(weight, dtype=torch.float32, device=device)

    @classmethod
    def of(cls, network: nn.Module, config: Any, device: torch.device | str) -> "Anchor | None":
        """Returns the anchor of a learner with settings `warm_start` and `anchor`; None without.

        Raises:
            UserError: there is an anchor, but no run whose actors it keeps.
        """
        if config.anchor and not config.warm_start:
            raise UserError(
                f"learner.anchor={config.anchor:g}: needs learner.warm_start, the run whose "
                "actions the actors stay near to"
            )
        return cls(network, config.anchor, device) if config.anchor else None

    def advance(self, done: float) -> None:
        """Sets the weight after a share of the run."""
        self.weight.fill_(self._first * max(0.0, 1 - done))

    def loss(self, action: Tensor, theirs: Tensor) -> Tensor:
        """Returns the weighted smooth L1 distance of actions, [...], given [..., actions] each."""
        distance = nn.functional.smooth_l1_loss(action, theirs, reduction="none")
        return self.weight * distance.mean(-1)
