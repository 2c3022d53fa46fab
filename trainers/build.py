"""Builds environments, networks and learners from a configuration."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torchrl.envs import TransformedEnv

from emberlink.comm.base import Communication
from emberlink.envs.scenarios import ScenarioConfig, grid_of
from emberlink.envs.utils.errors import UserError
from emberlink.envs.wildfire import WildfireEnv
from emberlink.policies.hold import held
from emberlink.policies.networks.messages import message_bytes, message_lag
from emberlink.policies.state import primer_of
from emberlink.trainers.config.compose import override, resolve
from emberlink.trainers.config.schema import RunConfig, build_comm
from emberlink.trainers.learners.base import LEARNERS, Learner, LearnerContext
from emberlink.trainers.rollout.teacher import Teacher


def make_env(
    method: str | RunConfig,
    setup: str | None = None,
    *,
    world: str | None = None,
    num_envs: int = 1,
    fire: str | ScenarioConfig | Tensor | None = None,
    seed: int | None = None,
    device: torch.device | str = "cpu",
    **settings: Any,
) -> TransformedEnv:
    """Returns the environment of a method with its communication.

    Args:
        method: independent, shared_memory, positional, consensus, maps, or a method of your own; or
            the configuration of a run, such as `load("pretrained:consensus").config`.
        setup: paper (if None), released, tuned, strong, or a setup of your own; not with a
            configuration.
        world: paper (if None), front, relay, swarm, blackout, file, or a world of your own; not
            with a configuration.
        fire: see `WildfireEnv`; the scenario of the setup or of the run if None.
        seed: seed of all random numbers of the environment; a random one if None.
        settings: other settings, by the last part of their key (`horizon=50`, `num_uavs=3`) or the
            whole key (`**{"env.reward.exit": -10.0}`).

    Raises:
        UserError: a method, setup, world or setting is not known, or a value is out of range.
    """
    grid = grid_of(fire)
    if grid is not None:
        settings.setdefault("grid", list(grid))
    if isinstance(method, str):
        choices = [f"setup={setup or 'paper'}", f"world={world or 'paper'}"]
        config = resolve(method, choices, **settings)
    elif isinstance(method, RunConfig) and setup is None and world is None:
        config = override(method, **settings)
    else:
        raise UserError("expected a method, a setup and a world, or a RunConfig alone")
    fire = config.fire if fire is None else fire
    env = build_env(config, num_envs=num_envs, fire=fire, seed=seed, device=device)
    policy = config.policy
    if policy.memory != "none" or policy.hold > 1 or message_lag(policy, config.env.radio):
        # The state that the policies carry from step to step.
        env.append_transform(primer_of(build_actor(config, env)))
    return env


def build_env(
    config: RunConfig,
    *,
    num_envs: int,
    fire: str | ScenarioConfig | Tensor,
    seed: int | Sequence[int] | None,
    device: torch.device | str,
    hold: int = 1,
    true_map: bool = False,
    teacher: str | None = None,
) -> TransformedEnv:
    """Returns the environment and communication of a configuration; see `WildfireEnv`.

    With a `teacher` (`LearnerConfig.reads_teacher`), its actions are written under `keys.TEACHER`.
    """
    world = WildfireEnv(num_envs, config.env, fire, seed, device, hold=hold, true_map=true_map)
    module = build_comm(config, num_envs).to(world.device)
    env = TransformedEnv(world, Communication(module, message_bytes(config.policy)))
    if teacher is not None:
        env.append_transform(Teacher(world, module.maps, teacher, config.policy.hold))
    return env


def empty_env(config: RunConfig) -> TransformedEnv:
    """Returns an environment of a configuration without fire, for the specs of a policy."""
    fire = torch.full(config.env.grid, torch.inf)
    return build_env(config, num_envs=1, fire=fire, seed=0, device=config.device)


def build_actor(
    config: RunConfig, env: TransformedEnv, generator: torch.Generator | None = None
) -> Any:
    """Returns new actors of a configuration's learner for an environment.

    A TensorDict module with the networks in `module`.
    """
    learner = LEARNERS.find(config.learner.name)
    specs = env.observation_spec, env.full_action_spec
    lag = message_lag(config.policy, config.env.radio)
    actor = learner.make_actor(config.learner, *specs, generator, config.policy, lag)
    return held(actor, config.policy.hold, config.env.num_uavs)


def build_learner(config: RunConfig, env: TransformedEnv) -> Learner:
    """Returns a new learner of a configuration for its environments."""
    context = LearnerContext(
        observation_spec=env.observation_spec,
        action_spec=env.full_action_spec,
        num_uavs=config.env.num_uavs,
        num_envs=config.num_envs,
        seed=config.seed,
        shared_replay=config.replay == "shared",
        total_steps=config.episodes * config.env.horizon // config.policy.hold,
        policy=config.policy,
        world=config.env,
        horizon=config.env.horizon // config.policy.hold,
        device=config.device,
        failures=config.env.failures > 0,
    )
    return LEARNERS.find(config.learner.name)(config.learner, context)
