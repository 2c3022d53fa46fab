"""Puts the parts of a recipe together."""

from collections.abc import Sequence
from typing import Any

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.envs import TransformedEnv

from emberlink.comm.base import Communication
from emberlink.envs.scenarios import ScenarioConfig
from emberlink.envs.utils.errors import UserError
from emberlink.envs.wildfire import WildfireEnv
from emberlink.policies.networks.stacked import Generators
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.config.schema import RunConfig, build_comm, check_device
from emberlink.trainers.learners import registry
from emberlink.trainers.learners.base import Learner, LearnerContext
from emberlink.trainers.learners.nan_guard import NonFiniteGuard


def make_env(
    method: str,
    setup: str = "paper",
    *,
    num_envs: int = 1,
    fire: str | ScenarioConfig | Tensor | None = None,
    seed: int = 0,
    device: torch.device | str = "cpu",
    **overrides: Any,
) -> TransformedEnv:
    """A recipe's whole environment, communication included.

    Args:
        method: a recipe: independent, shared_memory, positional, consensus, or one of yours.
        setup: paper, released, tuned, or one of yours.
        num_envs: environments side by side.
        fire: as for `WildfireEnv`; the setup's own scenario if None.
        seed: of everything random here.
        device: where all tensors live.
        overrides: any other setting, by its name (`horizon=50`, `num_uavs=3`) or, through a
            mapping, its full key (`**{"env.reward.exit": -10.0}`).

    Raises:
        ValueError: an unknown method, setup or setting, or a value out of range.
    """
    check_device(str(device))
    grid = list(fire.shape[-2:]) if isinstance(fire, Tensor) and fire.ndim in (2, 3) else None
    if grid and "grid" not in overrides:
        overrides["grid"] = grid
    config = resolve(method, [f"setup={setup}"], **overrides)
    if config.seeds:
        raise UserError(f"seeds={list(config.seeds)}: of a training; an environment takes seed=")
    fire = config.fire if fire is None else fire
    return build_env(config, num_envs=num_envs, fire=fire, seed=seed, device=device)


def build_env(
    config: RunConfig,
    *,
    num_envs: int,
    fire: str | ScenarioConfig | Tensor,
    seed: int | Sequence[int],
    device: torch.device | str,
) -> TransformedEnv:
    """The environment of a configuration: the wildfire and communication; see `WildfireEnv`."""
    world = WildfireEnv(num_envs, config.env, fire, seed, device)
    return TransformedEnv(world, Communication(build_comm(config).to(world.device)))


def build_actor(
    config: RunConfig, env: TransformedEnv, generator: Generators = None
) -> TensorDictModule:
    """Returns new actors of the configuration's learner for an environment."""
    learner = registry.find(config.learner.name)
    specs = env.observation_spec, env.full_action_spec
    return learner.make_actor(config.learner, *specs, generator)


def build_learner(config: RunConfig, env: TransformedEnv, guard: NonFiniteGuard) -> Learner:
    """Returns the learner of a configuration, for all its seeds.

    Args:
        config: of the run.
        env: the environments of all seeds, side by side.
        guard: told of all that the learner computes.
    """
    context = LearnerContext(
        observation_spec=env.observation_spec,
        action_spec=env.full_action_spec,
        num_uavs=config.env.num_uavs,
        num_envs=config.num_envs,
        seeds=config.seeds or (config.seed,),
        shared_replay=config.replay == "shared",
        total_steps=config.episodes * config.env.horizon,
        guard=guard,
        device=config.device,
    )
    return registry.build(config.learner, context)
