"""Computes the reward terms for flying towards the target (paper, section IV.F)."""

from typing import Literal

import torch
from pydantic.dataclasses import dataclass
from torch import Tensor

from emberlink.envs.config import Number
from emberlink.envs.utils.validation import STRICT


@dataclass(frozen=True, kw_only=True, config=STRICT)
class HeadingConfig:
    """Stores the settings of the bonus for flying to the target; the defaults are the paper's."""

    form: Literal["folded_linear", "folded_exponential", "linear", "approach"] = "folded_linear"
    """the formula, a key of `HEADING_FORMS`"""
    weight: Number = 1.0
    """factor of the term"""
    circle: Number = 0.0
    """factor of `circling`, which replaces the term of a UAV that sees old fire only; 0 for none"""


def _degrees(vector: Tensor) -> Tensor:
    """Returns the angles of vectors [..., 2 or 3] in the x-y plane, [...], in (-180, 180]."""
    return torch.rad2deg(torch.atan2(vector[..., 1], vector[..., 0]))


def _folded_difference(target: Tensor, moved: Tensor) -> Tensor:
    """Returns | |A_target| - |A_moved| |, degrees; as in the paper, it ignores the signs."""
    return (_degrees(target).abs() - _degrees(moved).abs()).abs()


def _folded_linear(target: Tensor, moved: Tensor) -> Tensor:
    return (180 - _folded_difference(target, moved)) / 10


def _folded_exponential(target: Tensor, moved: Tensor) -> Tensor:
    return 20 * 0.94 ** _folded_difference(target, moved)


def _linear(target: Tensor, moved: Tensor) -> Tensor:
    """Returns (90 - D) / 90 for an angle D between the vectors; 0 for a UAV that did not move."""
    difference = (_degrees(target) - _degrees(moved) + 180).remainder(360) - 180
    return torch.where((moved[..., :2] == 0).all(-1), 0.0, (90 - difference.abs()) / 90)


def _approach(target: Tensor, moved: Tensor) -> Tensor:
    """Returns the cells by which the 3-D distance to the target has decreased."""
    return torch.linalg.vector_norm(target, dim=-1) - torch.linalg.vector_norm(
        target - moved, dim=-1
    )


HEADING_FORMS = {
    "folded_linear": _folded_linear,
    "folded_exponential": _folded_exponential,
    "linear": _linear,
    "approach": _approach,
}
"""the formula of each form, of the vector to the target and the vector of the move, [..., 3]"""


def heading_reward(before: Tensor, after: Tensor, target: Tensor, config: HeadingConfig) -> Tensor:
    """Computes the heading term, float32 [...].

    Angles are measured in the x-y plane, in degrees, from the position before the move. They are
    computed in float64: a move of 0.1 cells is a difference of nearly equal float32 numbers.

    Args:
        before, after: float32 [..., 3], positions before and after the move, cells.
        target: float32 [..., 3], the target that the UAV had before the move, cells.
        config: form and weight.
    """
    before = before.double()
    term = HEADING_FORMS[config.form](target.double() - before, after.double() - before)
    return (config.weight * term).float()


def circling(before: Tensor, after: Tensor, target: Tensor) -> Tensor:
    """Computes the cells flown around the target counterclockwise, float32 [...].

    The term is the component of the move perpendicular to the vector to the target, times
    2 d / (1 + d^2), where d is the horizontal distance to the target in cells. This factor is 1 at
    a distance of 1 and smaller both nearer to the target and further away.

    Args:
        before, after, target: as of `heading_reward`.
    """
    offset, moved = (end[..., :2].double() - before[..., :2].double() for end in (target, after))
    arm = 2 * offset / (1 + offset.square().sum(-1, keepdim=True))
    return (moved[..., 0] * arm[..., 1] - moved[..., 1] * arm[..., 0]).float()
