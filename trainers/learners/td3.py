"""TD3 for all UAVs (Fujimoto, van Hoof and Meger 2018, ICML)."""

from collections.abc import Callable
from typing import Annotated, Any

import torch
from pydantic import Field
from pydantic.dataclasses import dataclass
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.objectives import TD3Loss

from emberlink.envs import keys
from emberlink.policies.networks import TAKEN
from emberlink.trainers.learners.base import (
    STRICT,
    Count,
    Losses,
    NotNegative,
    mean_over_batch,
)
from emberlink.trainers.learners.ddpg import DDPG, DDPGConfig

_TARGET_NOISE = (keys.AGENTS, "target_noise")
"""float32 [batch, uavs, 3], under "next": noise on the target actors' actions"""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class TD3Config(DDPGConfig):
    """Stores the settings of TD3."""

    policy_delay: Count
    """updates of the critics per update of the actors and the target networks"""
    target_noise: NotNegative
    """standard deviation of the noise on the target actors' actions"""
    target_noise_clip: Annotated[float, Field(ge=0, le=2)]
    """maximum absolute value of the target noise; actions are in [-1, 1]"""


class TD3(DDPG):
    """Updates the actor and two critics of each UAV, with target smoothing and delayed actors.

    Everything else is as in DDPG.
    """

    config_type = TD3Config
    config: TD3Config

    def _make_loss(self, critic: Callable[[], Any]) -> tuple[Any, Any]:
        critics, bounds = [critic(), critic()], (-1.0, 1.0)
        # A list of critics, or TorchRL draws weights itself.
        loss = TD3Loss(
            SmoothedActor(self.actor, critics[0]),  # pyright: ignore[reportArgumentType]
            critics,
            bounds=bounds,  # pyright: ignore[reportArgumentType]
            policy_noise=0.0,  # TorchRL's noise is of the global generator; `update` draws it
            noise_clip=0.0,
            loss_function="l2",
            reduction="none",
            deactivate_vmap=True,
        )
        loss.set_keys(action=keys.ACTION)
        return loss, loss.qvalue_network_params

    def update(self, batch: TensorDictBase) -> Losses:
        """Updates the critics, and with every `policy_delay`-th update actors and targets.

        Args:
            batch: transitions for each UAV, batch size [batch].
        """
        config = self.config
        self.updates += 1
        moves_actor = self.updates % config.policy_delay == 0
        normal = torch.empty_like(batch.get(keys.ACTION)).normal_(generator=self.generator)
        clip = config.target_noise_clip
        noise = (normal * config.target_noise).clamp(-clip, clip)
        losses = self.losses(batch.copy().set(("next", *_TARGET_NOISE), noise), actor=moves_actor)
        torch.stack([*losses.values()]).sum().backward()
        self.optimizer.step()
        self.optimizer.zero_grad()
        if moves_actor:
            self.targets.step()
        return {name: value.detach() for name, value in losses.items()}

    def losses(self, batch: TensorDictBase, *, actor: bool = True) -> Losses:
        """Computes the losses with gradients, one number per UAV; the actors' if asked for."""
        if self.config.critic == "team":
            batch = batch.copy().set(TAKEN, batch.get(keys.ACTION))
        alive = batch.get(keys.ALIVE, None)
        losses = {"critic": mean_over_batch(self.loss.value_loss(batch)[0], alive)}
        if actor:
            losses["actor"] = mean_over_batch(self.loss.actor_loss(batch)[0], alive)
        return losses


class SmoothedActor(TensorDictModuleBase):
    """Adds the noise in a batch, if there is any, to the actors' actions and clips them.

    It passes on the critics' inputs.
    """

    def __init__(self, actor: TensorDictModuleBase, critic: TensorDictModuleBase):
        super().__init__()
        self.actor = actor
        passed = [key for key in critic.in_keys if key != keys.ACTION]
        reads: list[Any] = list(dict.fromkeys([*actor.in_keys, _TARGET_NOISE, *passed]))
        writes: list[Any] = list(actor.out_keys)
        self.in_keys, self.out_keys = reads, writes

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        acted = self.actor(tensordict)
        noise = acted.get(_TARGET_NOISE, None)
        if noise is None:
            return acted
        return acted.set(keys.ACTION, (acted.get(keys.ACTION) + noise).clamp(-1, 1))
