"""Builds environments and networks from a configuration."""

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
from emberlink.policies.networks.actor_critic import make_actor, make_critic
from emberlink.policies.networks.layers import Generators
from emberlink.trainers.config.compose import override, resolve
from emberlink.trainers.config.schema import RunConfig, build_comm, check_device


def make_env(
    method: str | RunConfig,
    setup: str | None = None,
    *,
    num_envs: int = 1,
    fire: str | ScenarioConfig | Tensor | None = None,
    seed: int = 0,
    device: torch.device | str = "cpu",
    **settings: Any,
) -> TransformedEnv:
    """Returns the environment of a method, communication included.

    Args:
        method: independent, shared_memory, positional, consensus, or one of yours; or the
            configuration of a run, such as `load("pretrained:consensus").config`.
        setup: paper (if None), released, tuned, or one of yours; not with a configuration.
        num_envs: environments side by side.
        fire: as for `WildfireEnv`; the scenario of the setup or of the run if None.
        seed: of everything random in the environment.
        device: where all tensors live.
        settings: any other setting, by the last part of its key (`horizon=50`, `num_uavs=3`) or by
            all of it (`**{"env.reward.exit": -10.0}`).

    Raises:
        UserError: an unknown method, setup or setting, or a value out of range.
    """
    check_device(str(device))
    if isinstance(fire, Tensor) and fire.ndim in (2, 3):
        settings.setdefault("grid", list(fire.shape[-2:]))
    if "seeds" in settings:
        raise UserError(f"seeds={settings['seeds']}: of a training; an environment takes seed=")
    if isinstance(method, str):
        config = resolve(method, [f"setup={setup or 'paper'}"], **settings)
    elif isinstance(method, RunConfig) and setup is None:
        config = override(method, **settings)
    else:
        raise UserError("expected a method and a setup, or a RunConfig alone")
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
    """Returns the wildfire and the communication of a configuration; see `WildfireEnv`."""
    world = WildfireEnv(num_envs, config.env, fire, seed, device)
    return TransformedEnv(world, Communication(build_comm(config, num_envs).to(world.device)))


def build_networks(
    config: RunConfig, env: TransformedEnv, generator: Generators = None
) -> tuple[TensorDictModule, TensorDictModule]:
    """Returns actors and critics of all UAVs; several generators make those of as many seeds."""
    specs = env.observation_spec, env.full_action_spec, config.learner.hidden
    actor = make_actor(*specs, generator=generator)
    return actor, make_critic(*specs, generator=generator)
