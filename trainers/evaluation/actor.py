"""Loads the frozen policy of a run."""

from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModule
from torchrl.envs import TransformedEnv

from emberlink.envs import keys
from emberlink.trainers.build import build_actor, build_env
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.learners.base import ACTOR
from emberlink.trainers.runs.checkpoints import load_weights


def load_actor(config: RunConfig, checkpoint: Path) -> TensorDictModule:
    """Returns the frozen policy of a checkpoint, which maps observations to ("agents", "action").

    Raises:
        UserError: the checkpoint cannot be read or does not fit the configuration.
    """
    actor = build_actor(config, _fireless(config))
    network: Any = actor.module
    expected = {ACTOR + name: value for name, value in network.state_dict().items()}
    weights = load_weights(checkpoint, expected, config)
    network.load_state_dict({name.removeprefix(ACTOR): v for name, v in weights.items()})
    return actor.requires_grad_(False)


def observed(config: RunConfig) -> dict[tuple[str, str], torch.Size]:
    """Returns the keys that the networks of a configuration read, and their shapes per UAV."""
    spec = _fireless(config).observation_spec
    shapes = map(torch.Size, keys.observation_shapes(spec))
    return dict(zip(keys.observation_keys(spec), shapes, strict=True))


def _fireless(config: RunConfig) -> TransformedEnv:
    """Returns one environment without a fire."""
    return build_env(
        config,
        num_envs=1,
        fire=torch.full(config.env.grid, torch.inf),
        seed=0,
        device=config.device,
    )
