"""Models the radio: computes which UAVs hear each other in a step."""

from typing import Annotated

import torch
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass
from tensordict import TensorDictBase
from torch import Tensor

from emberlink.envs import keys
from emberlink.envs.utils import counter_rng
from emberlink.envs.utils.counter_rng import Use
from emberlink.envs.world import motion


@dataclass(frozen=True, kw_only=True, config=ConfigDict(extra="forbid", strict=True))
class RadioConfig:
    """The settings of a radio; the configuration of a method with a radio inherits them."""

    range: Annotated[float, Field(ge=0)] = 10.0
    """UAVs at a distance below this hear each other, cells; .inf for no limit"""
    loss: Annotated[float, Field(ge=0, le=1)] = 0.0
    """probability that a UAV does not hear another one in a step, each direction independently"""


class Radio:
    """Computes the communication links of a step.

    `Communication` writes them under `keys.HEARS` once per step, where communication modules and
    pictures read them.

    Args:
        config: range and loss.
    """

    def __init__(self, config: RadioConfig):
        self.config = config

    def links(self, tensordict: TensorDictBase) -> Tensor:
        """Returns the links, bool [..., n, n]: row i marks the UAVs that UAV i hears.

        The lost messages are a function of the episode's random key and the step.

        Args:
            tensordict: positions, random key and step of one time step.
        """
        links = neighbours(tensordict.get(keys.POSITION), self.config.range)
        if self.config.loss:
            uavs = links.shape[-1]
            key = counter_rng.step_key(
                tensordict.get(keys.RNG_KEY), tensordict.get(keys.STEP), Use.MESSAGE_LOSS
            )
            unit = counter_rng.uniform(key, uavs * uavs).unflatten(-1, (uavs, uavs))
            links = links & (unit >= self.config.loss)
        return links


def pairwise_distance(position: Tensor) -> Tensor:
    """Returns the distances between UAVs at positions [..., n, 3], float64 [..., n, n], cells."""
    return motion.distance(position.unsqueeze(-2), position.unsqueeze(-3))


def neighbours(position: Tensor, limit: float) -> Tensor:
    """Returns whether each other UAV is nearer than `limit`, bool [..., n, n].

    Args:
        position: float32 [..., n, 3], cells.
        limit: communication range, cells.
    """
    near = pairwise_distance(position) < limit
    return near & ~torch.eye(near.shape[-1], dtype=torch.bool, device=near.device)
