"""Reward terms for flying towards the target."""

from typing import Literal

import torch
from pydantic import ConfigDict
from pydantic.dataclasses import dataclass
from torch import Tensor

from emberlink.envs.config import Number


@dataclass(frozen=True, kw_only=True, config=ConfigDict(extra="forbid", strict=True))
class HeadingConfig:
    """The bonus for flying towards the target (paper, section IV.F); defaults: the paper's."""

    form: Literal["folded_linear", "folded_exponential", "linear", "approach"] = "folded_linear"
    """one of `HEADING_FORMS`"""
    weight: Number = 1.0
    """factor on the term"""
    circle: Number = 0.0
    """where not 0, factor on `circling`, which replaces the term over old fire alone"""


def _degrees(vector: Tensor) -> Tensor:
    return torch.rad2deg(torch.atan2(vector[..., 1], vector[..., 0]))


def _folded_difference(target: Tensor, moved: Tensor) -> Tensor:
    """| |A_target| - |A_moved| | as printed: it takes left and right for the same."""
    return (_degrees(target).abs() - _degrees(moved).abs()).abs()


def _folded_linear(target: Tensor, moved: Tensor) -> Tensor:
    return (180 - _folded_difference(target, moved)) / 10


def _folded_exponential(target: Tensor, moved: Tensor) -> Tensor:
    return 20 * 0.94 ** _folded_difference(target, moved)


def _linear(target: Tensor, moved: Tensor) -> Tensor:
    """(90 - D) / 90 with D the true angle between the two; 0 where the UAV stood still."""
    difference = (_degrees(target) - _degrees(moved) + 180).remainder(360) - 180
    return torch.where((moved[..., :2] == 0).all(-1), 0.0, (90 - difference.abs()) / 90)


def _approach(target: Tensor, moved: Tensor) -> Tensor:
    """Cells by which the UAV came nearer to its target, altitude included."""
    return torch.linalg.vector_norm(target, dim=-1) - torch.linalg.vector_norm(
        target - moved, dim=-1
    )


HEADING_FORMS = {
    "folded_linear": _folded_linear,
    "folded_exponential": _folded_exponential,
    "linear": _linear,
    "approach": _approach,
}


def heading_reward(before: Tensor, after: Tensor, target: Tensor, config: HeadingConfig) -> Tensor:
    """The heading term, float32 [...].

    Args:
        before, after: float32 [..., 3], positions before and after the move, cells.
        target: float32 [..., 3], where the UAV was told to go before the move, cells.

    Angles are taken in the x-y plane, in degrees, from the position before the move; computed in
    float64 because 0.1 cells of movement leave few digits.
    """
    before = before.double()
    term = HEADING_FORMS[config.form](target.double() - before, after.double() - before)
    return (config.weight * term).float()


def circling(before: Tensor, after: Tensor, target: Tensor) -> Tensor:
    """Cells flown around the target with the target to the left, float32 [...].

    The move's component across the way to the target, times 2 d / (1 + d^2) at a distance of d:
    full at 1 cell, less where the target is underneath the UAV or about to be lost from view.
    Arguments as `heading_reward`.
    """
    way, moved = (end[..., :2].double() - before[..., :2].double() for end in (target, after))
    arm = 2 * way / (1 + way.square().sum(-1, keepdim=True))
    return (moved[..., 0] * arm[..., 1] - moved[..., 1] * arm[..., 0]).float()
