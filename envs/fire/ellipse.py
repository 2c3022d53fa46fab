"""Computes the rates of the elliptical wavelet that spreads from every point of a front.

The half length of a wavelet grows at the rate `a` and its half breadth at `b`. Its centre moves at
`c` along the axis. Rates are in cells per step. Angles are in radians, counter-clockwise from +x,
and give the direction in which the head moves.
"""

import torch
from torch import Tensor

from emberlink.envs.utils.errors import UserError

MAX_LENGTH_TO_BREADTH = 8.0


def length_to_breadth(wind: float | Tensor) -> Tensor:
    """Returns the length-to-breadth ratio of a wildfire in wind (Anderson 1983, USDA INT-305).

    Args:
        wind: mid-flame wind speed in m/s, not negative, any shape.

    Returns:
        0.936 exp(0.2566 U) + 0.461 exp(−0.1548 U) − 0.397, at most 8, in the shape of `wind`.
    """
    speed = torch.as_tensor(wind)
    if (speed < 0).any():
        raise UserError(f"wind speed must not be negative, got {speed.min().item()}")
    ratio = 0.936 * torch.exp(0.2566 * speed) + 0.461 * torch.exp(-0.1548 * speed) - 0.397
    return ratio.clamp(1.0, MAX_LENGTH_TO_BREADTH)


def ellipse_rates(
    head_ros: float | Tensor, length_to_breadth: float | Tensor, two_sided: bool = False
) -> tuple[Tensor, Tensor, Tensor]:
    """Returns the rates of the ellipse of a point source, which lies in one of its foci.

    Args:
        head_ros: rate of the head, cells per step.
        length_to_breadth: at least 1, broadcast against `head_ros`.
        two_sided: whether the source lies in the centre, so that the back is as fast as the head.

    Returns:
        (a, b, c): growth of the half length, of the half breadth, and speed of the centre.
    """
    head, ratio = torch.as_tensor(head_ros), torch.as_tensor(length_to_breadth)
    if (ratio < 1).any():
        raise UserError(f"length_to_breadth must be at least 1, got {ratio.min().item()}")
    if two_sided:
        return head, head / ratio, torch.zeros_like(head)
    eccentricity = torch.sqrt(ratio**2 - 1) / ratio
    back = head * (1 - eccentricity) / (1 + eccentricity)
    a = (head + back) / 2
    return a, a / ratio, (head - back) / 2
