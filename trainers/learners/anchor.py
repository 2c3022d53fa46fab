"""Penalises actions that differ from those of the actors that a run began with."""

import copy
from typing import Any

import torch
from pydantic import model_validator
from pydantic.dataclasses import dataclass
from torch import Tensor, nn

from emberlink.envs.utils.errors import UserError
from emberlink.trainers.learners.base import STRICT, LearnerConfig, NotNegative


@dataclass(frozen=True, kw_only=True, config=STRICT)
class WarmStartConfig(LearnerConfig):
    """Stores the settings of learners that can begin with the actors of another run."""

    warm_start: str = ""
    """run folder, or `pretrained:…`, whose actors the run begins with; none if empty"""
    anchor: NotNegative = 0.0
    """weight of the distance to the actions of `warm_start`; it falls linearly to 0 at the end"""

    @model_validator(mode="after")
    def _an_anchor_has_a_start(self) -> "WarmStartConfig":
        if self.anchor and not self.warm_start:
            raise UserError(
                f"learner.anchor={self.anchor:g}: needs learner.warm_start, the run whose actions "
                "the actors stay near to"
            )
        return self


class Anchor:
    """Keeps a frozen copy of actors, and adds a loss where the learned actors act differently.

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
        """Returns the anchor of a learner with settings `warm_start` and `anchor`; None without."""
        return cls(network, config.anchor, device) if config.anchor else None

    def advance(self, done: float) -> None:
        """Sets the weight after a share of the run."""
        self.weight.fill_(self._first * max(0.0, 1 - done))

    def loss(self, action: Tensor, theirs: Tensor) -> Tensor:
        """Returns the weighted smooth L1 distance of actions, [...], given [..., actions] each."""
        distance = nn.functional.smooth_l1_loss(action, theirs, reduction="none")
        return self.weight * distance.mean(-1)
