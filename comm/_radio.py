"""The radio: which UAV hears which other one in a step."""

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
    """The settings of a radio. The settings of a method with a radio inherit from it."""

    range: Annotated[float, Field(ge=0)] = 10.0
    """UAVs at a distance below this hear each other, cells; .inf for no limit"""
    loss: Annotated[float, Field(ge=0, le=1)] = 0.0
    """probability that a UAV does not hear another one in a step, each direction independently"""


class Radio:
    """Decides who hears whom in a step.

    `Communication` writes the result under `keys.HEARS`, once per step. Communication modules,
    pictures and tests read it there.

    Args:
        config: range and loss.
    """

    def __init__(self, config: RadioConfig):
        self.config = config

    def links(self, tensordict: TensorDictBase) -> Tensor:
        """Returns who hears whom, bool [..., n, n]: row i holds the UAVs that UAV i hears.

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
    """Returns the distances between UAVs, float64 [..., n, n], cells; of positions [..., n, 3]."""
    return motion.distance(position.unsqueeze(-2), position.unsqueeze(-3))


def neighbours(position: Tensor, limit: float) -> Tensor:
    """Returns which other UAVs are at a distance below `limit`, bool [..., n, n].

    Args:
        position: float32 [..., n, 3], cells.
        limit: communication range, cells.
    """
    near = pairwise_distance(position) < limit
    return near & ~torch.eye(near.shape[-1], dtype=torch.bool, device=near.device)
