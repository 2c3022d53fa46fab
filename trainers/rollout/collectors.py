"""The collectors of a training: what they carry from step to step can be taken and given back."""

from dataclasses import asdict
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv

from emberlink.policies.exploration import OrnsteinUhlenbeck
from emberlink.trainers.config.schema import RunConfig

from .cuda_graphs import LockstepCollector


class CarryingCollector(Collector):
    """TorchRL's collector, which keeps out of its own state what it carries between steps."""

    @property
    def carried(self) -> TensorDictBase:
        """The moment that the next step begins with: observations, communication, noise."""
        return self._carrier

    def go_on(self, carried: TensorDictBase, step: int) -> None:
        """Goes on from a moment, so many steps into the run."""
        self._carrier = carried
        self._frames = step * carried.numel()


def make_collector(
    config: RunConfig, env: TransformedEnv, actor: TensorDictModule, *, envs: int, steps: int
) -> CarryingCollector | LockstepCollector:
    """The collector of a configuration: actors with noise, one step of all environments at a time.

    Args:
        config: of the run.
        env: environments side by side, with their communication.
        actor: the actors of all UAVs, without noise.
        envs: how many environments.
        steps: of all environments, in all.
    """
    parts: list[Any] = [actor, OrnsteinUhlenbeck(**asdict(config.exploration))]
    explorer = TensorDictSequential(*parts)
    if torch.device(config.device).type == "cuda":
        return LockstepCollector(env, explorer, horizon=config.env.horizon, steps=steps)
    return CarryingCollector(
        env,
        explorer,
        frames_per_batch=envs,
        total_frames=steps * envs,
        device=config.device,
        trust_policy=True,
        track_traj_ids=False,
        auto_register_policy_transforms=False,
    )
