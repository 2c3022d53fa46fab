"""Loads the frozen policy of a run."""

from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModule

from emberlink.trainers.build import build_actor, build_env
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.learners.base import ACTOR
from emberlink.trainers.runs.checkpoints import load_weights


def load_actor(config: RunConfig, checkpoint: Path) -> TensorDictModule:
    """Returns the frozen policy of a checkpoint, which maps observations to ("agents", "action").

    Raises:
        UserError: the checkpoint cannot be read or does not fit the configuration.
    """
    env = build_env(
        config,
        num_envs=1,
        fire=torch.full(config.env.grid, torch.inf),
        seed=0,
        device=config.device,
    )
    actor = build_actor(config, env)
    network: Any = actor.module
    expected = {ACTOR + name: value for name, value in network.state_dict().items()}
    weights = load_weights(checkpoint, expected, config)
    network.load_state_dict({name.removeprefix(ACTOR): v for name, v in weights.items()})
    return actor.requires_grad_(False)
