"""Spaces of observations and actions for PettingZoo and Gymnasium."""

from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box, Dict, Space
from numpy.typing import NDArray
from torchrl.envs import EnvBase

from emberlink.envs import keys
from emberlink.envs.config import WildfireConfig
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import shown

Array = NDArray[np.float32]


def to_action(action: Any, size: int, agent: str = "the team") -> Array:
    """Returns an action as an array, float32 [size].

    Raises:
        UserError: it is no array of numbers, or has another shape.
    """
    try:
        numbers = np.asarray(action, np.float32)
    except (TypeError, ValueError, OverflowError):
        raise UserError(f"action of {agent}: {shown(action)} is no array of numbers") from None
    if numbers.shape != (size,):
        got = numbers.shape
        raise UserError(f"an action is an array of shape ({size},), got {got} for {agent}")
    return numbers


def team_spaces(env: EnvBase, config: WildfireConfig) -> tuple[Box, dict[str, Box]]:
    """Returns the spaces of the vector, and of the other tensors of an observation by name."""
    low, high = _bounds(config, env.observation_spec[keys.OBSERVATION].shape[-1])
    _, *others = keys.observation_keys(env.observation_spec)
    pictures: dict[str, Box] = {}
    for key in others:
        spec = env.observation_spec[key]
        pictures[key[1]] = Box(0, 1 if spec.dtype == torch.bool else 255, spec.shape[2:], np.uint8)
    return Box(low, high, dtype=np.float32), pictures


def observation_space(vector: Box, pictures: dict[str, Box]) -> Space:
    """Returns a new space of one agent's observations."""
    copied = Box(vector.low, vector.high, dtype=np.float32)
    if not pictures:
        return copied
    other = {name: Box(box.low, box.high, dtype=np.uint8) for name, box in pictures.items()}
    return Dict({keys.OBSERVATION[1]: copied, **other})


def _bounds(config: WildfireConfig, features: int) -> tuple[Array, Array]:
    """Returns the smallest and largest vector; infinite where communication added numbers."""
    if features != len(keys.FEATURES):
        limit = np.full(features, np.inf, np.float32)
        return -limit, limit
    if config.observation_scale == "box":
        low, high = [-1, -1, -1, 0, 0, 0], [1, 1, 1, 1, 1, 1]
    else:
        low, high = [*config.low, 0, 0, 0], [*config.high, 1, 1, config.horizon]
    return np.array(low, np.float32), np.array(high, np.float32)
