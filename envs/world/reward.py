"""The rewards: pure functions, and their constants."""

from typing import Literal

from torch import Tensor

from emberlink.envs.config import RewardConfig


def left_box(beyond: Tensor, axes: Literal["xyz", "xy"]) -> Tensor:
    """Whether the last move would have left the box on the tested axes, bool [...].

    Args:
        beyond: bool [..., 3], per axis.
        axes: the axes that are tested.
    """
    return beyond[..., : len(axes)].any(-1)


def view_reward(
    new: Tensor, old: Tensor, none: Tensor, beyond: Tensor, config: RewardConfig
) -> Tensor:
    """The reward for what is in view, or the penalty for leaving the box, float32 [...].

    Args:
        new, old, none: whole numbers [...], cells in view of each class.
        beyond: bool [..., 3], the axes along which the move would have left the box.
    """
    earned = config.new_fire * new
    earned.add_(old, alpha=config.old_fire).add_(none, alpha=config.no_fire)
    return earned.masked_fill_(left_box(beyond, config.exit_axes), config.exit).float()
