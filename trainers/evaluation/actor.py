"""Loads the frozen policy of a run."""

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModule
from torchrl.envs import TransformedEnv

from emberlink.comm import registry
from emberlink.envs.utils.validation import shown
from emberlink.trainers.build import build_actor, build_env
from emberlink.trainers.config.compose import to_values
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.config.values import flat
from emberlink.trainers.learners.base import ACTOR
from emberlink.trainers.runs.checkpoint import load_weights, read_header

_UNITS = ("altitude", "horizon", "displacement", "view_angle", "observation_scale")


def load_actor(
    config: RunConfig, checkpoint: Path, env: TransformedEnv | None = None
) -> TensorDictModule:
    """Returns the frozen policy of a checkpoint, which maps observations to ("agents", "action").

    It warns if the networks see a base here and saw none in training, or if the map, the altitudes,
    the horizon, the speed, the view or the units of observations, also those of the communication,
    are not those of the training.

    Args:
        config: configuration of the run.
        checkpoint: file of the networks.
        env: the environment whose observations they read; a new one of `fireless` if None.

    Raises:
        UserError: the checkpoint cannot be read or does not fit the configuration.
    """
    actor = build_actor(config, fireless(config) if env is None else env)
    network: Any = actor.module
    expected = {ACTOR + name: value for name, value in network.state_dict().items()}
    weights = load_weights(checkpoint, expected, config)
    trained = read_header(checkpoint).config
    if config.env.observation == "sight" and config.env.base and not trained["env"]["base"]:
        warnings.warn(
            f"env.base={list(config.env.base)}: the networks were trained without a base, so the "
            "weights of the pixels that show one keep their initial values",
            stacklevel=2,
        )
    _warn_of_other_units(config, trained)
    network.load_state_dict({name.removeprefix(ACTOR): v for name, v in weights.items()})
    return actor.requires_grad_(False)


def units(config: RunConfig) -> tuple[str, ...]:
    """Returns the keys that change what the numbers in observations and actions mean.

    The grid is among them if a UAV observes where in the box it is.
    """
    by_map = config.env.observation != "sight" or config.comm.get("position", False)
    world = ("grid", *_UNITS) if by_map else _UNITS
    said = registry.find(config.comm["name"]).units
    return (*(f"env.{key}" for key in world), *(f"comm.{key}" for key in said))


def _warn_of_other_units(config: RunConfig, trained: Mapping[str, Any]) -> None:
    """Warns of settings with which observed and flown distances mean something else."""
    here, there = flat(to_values(config)), flat(trained)
    differ = [
        f"{key}={shown(here[key])} (in training {shown(there[key])})"
        for key in units(config)
        if here[key] != there.get(key, here[key])
    ]
    if differ:
        warnings.warn(
            f"{', '.join(differ)}: what the networks observe and do means something else here",
            stacklevel=3,
        )


def fireless(config: RunConfig) -> TransformedEnv:
    """Returns one environment without a fire."""
    return build_env(
        config,
        num_envs=1,
        fire=torch.full(config.env.grid, torch.inf),
        seed=0,
        device=config.device,
    )
