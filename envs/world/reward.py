"""Computes rewards from the cells in view and the move: pure functions of tensors."""

from typing import Literal

from torch import Tensor

from emberlink.envs.config import RewardConfig


def left_box(hit_boundary: Tensor, axes: Literal["xyz", "xy"]) -> Tensor:
    """Returns whether a move, bool [..., 3], left the box on the tested axes, bool [...]."""
    return hit_boundary[..., : len(axes)].any(-1)


def step_reward(
    new: Tensor,
    old: Tensor,
    none: Tensor,
    hit_boundary: Tensor,
    config: RewardConfig,
    told: Tensor | None = None,
    unseen: Tensor | None = None,
) -> Tensor:
    """Returns the reward for the cells in view and for news, or the penalty for leaving the box.

    The reward for burning cells that no UAV has seen is added to either.

    Args:
        new, old, none: [...], number of cells of new fire, old fire and no fire in view.
        hit_boundary: bool [..., 3], the axes along which the move would have left the box.
        told: integers [...], number of burning cells new to the base; None for none.
        unseen: integers [...], number of burning cells that no UAV has seen; None for none.

    Returns:
        float32 [...].
    """
    reward = config.new_fire * new
    reward.add_(old, alpha=config.old_fire).add_(none, alpha=config.no_fire)
    if told is not None:
        reward.add_(told, alpha=config.base)
    reward = reward.masked_fill_(left_box(hit_boundary, config.exit_axes), config.exit).float()
    if unseen is not None:
        reward.add_(unseen.float().log1p(), alpha=config.unseen)
    return reward
