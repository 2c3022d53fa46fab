"""Computes the vector that each UAV observes: a pure function of tensors."""

import torch
from torch import Tensor

from emberlink.envs.config import WildfireConfig
from emberlink.envs.world import motion


def observe(
    position: Tensor,
    counts: Tensor,
    step: Tensor,
    config: WildfireConfig,
    box: tuple[Tensor, Tensor],
) -> Tensor:
    """Returns x, y, z, new-fire flag, old-fire flag and step (paper, section IV.C).

    Args:
        position: float32 [envs, n, 3], cells.
        counts: int64 [envs, n, 3], cells of new fire, old fire and no fire in view.
        step: int64 [envs], steps since the episode began.
        config: scale of the observation.
        box: the corners of the box, from `motion.corners`.

    Returns:
        float32 [envs, n, 6].
    """
    clock = step.float().view(-1, 1, 1).expand(-1, position.shape[1], 1)
    if config.observation_scale == "box":
        position = motion.scale_to_box(position, *box)
        clock = clock / config.horizon
    return torch.cat((position, counts[..., :2] > 0, clock), -1)
