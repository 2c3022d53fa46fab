"""TD3 for all UAVs (Fujimoto, van Hoof and Meger 2018, ICML)."""

from typing import Annotated, Any

import torch
from pydantic import Field
from pydantic.dataclasses import dataclass
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.objectives import TD3Loss

from emberlink.envs import keys
from emberlink.envs.utils import counter_rng
from emberlink.envs.utils.counter_rng import Use
from emberlink.trainers.learners.base import STRICT, Count, LearnerContext, Losses, NotNegative
from emberlink.trainers.learners.off_policy import OffPolicyConfig, OffPolicyLearner

_TARGET_NOISE = (keys.AGENTS, "target_noise")
"""float32 [batch, uavs, 3], under "next": noise on the target actors' actions"""
_CRITICS = 2


@dataclass(frozen=True, kw_only=True, config=STRICT)
class TD3Config(OffPolicyConfig):
    """Stores the settings of TD3."""

    policy_delay: Count
    """updates of the critics per update of the actors and the target networks"""
    target_noise: NotNegative
    """standard deviation of the noise on the target actors' actions"""
    target_noise_clip: Annotated[float, Field(ge=0, le=2)]
    """maximum absolute value of that noise; actions are in [-1, 1]"""


class TD3(OffPolicyLearner):
    """Updates the actor and two critics of each UAV, with target smoothing and delayed actors."""

    config_type = TD3Config
    critic_name = "qvalue"
    config: TD3Config

    def __init__(self, config: TD3Config, context: LearnerContext):
        super().__init__(config, context)
        seeds = torch.tensor(context.seeds, device=context.device)
        self._keys = counter_rng.fold_in(seeds, Use.TARGET_NOISE)

    def make_loss(self, context: LearnerContext, generators: list[torch.Generator]) -> TD3Loss:
        actor, critics = self.make_networks(context, generators, _CRITICS)
        smoothed: Any = _SmoothedActor(actor, critics[0])
        bounds: Any = (-1.0, 1.0)
        loss = TD3Loss(
            smoothed,
            critics,  # a list, so that TorchRL does not draw weights itself
            bounds=bounds,
            policy_noise=0.0,  # `sample` draws the noise
            noise_clip=0.0,
            loss_function="l2",
            reduction="none",
            deactivate_vmap=True,
        )
        loss.set_keys(action=keys.ACTION)
        return loss

    def moves_actor(self, update: int) -> bool:
        return update % self.config.policy_delay == 0

    def sample(self) -> TensorDictBase:
        """Draws a batch and the noise on the target actors' actions."""
        batch, config = self.replay.sample(), self.config
        action = batch.get(keys.ACTION)
        key = counter_rng.fold_in(self._keys, self.replay.draws)
        normal = counter_rng.normal(key, action.numel() // self.teams)
        by_team = normal.view(self.teams, len(action), -1, *action.shape[2:])
        noise = by_team.transpose(0, 1).reshape(action.shape)
        clip = config.target_noise_clip
        batch.set(("next", *_TARGET_NOISE), (noise * config.target_noise).clamp(-clip, clip))
        return batch

    def losses(self, batch: TensorDictBase, *, actor: bool = True) -> Losses:
        loss: Any = self.loss
        critic_loss, _ = loss.value_loss(batch)
        losses = {"critic": self.mean_over_batch(critic_loss, batch)}
        if actor:
            actor_loss, _ = loss.actor_loss(batch)
            losses["actor"] = self.mean_over_batch(actor_loss, batch)
        return losses

    def gradients(self) -> dict[str, Tensor]:
        """Returns the gradients by parameter, with separate entries for the two critics."""
        gradients: dict[str, Tensor] = {}
        for name, value in super().gradients().items():
            network, _, rest = name.partition(".")
            if network == "actor":
                gradients[name] = value
            else:
                gradients |= {f"critic_{k}.{rest}": part for k, part in enumerate(value)}
        return gradients

    def stack_dim(self, name: str) -> int:
        """Returns 1 for critics, whose weights have the critic as the first dimension, else 0."""
        return int("qvalue" in name)

    def weights(self, team: int = 0) -> dict[str, Tensor]:
        weights = super().weights(team)
        return {
            name.replace("params.actor.module.", "params.module."): weight
            for name, weight in weights.items()
        }


class _SmoothedActor(TensorDictModuleBase):
    """Adds the noise in a batch, if there is any, to the actors' actions and clips them.

    It passes on what the critics read.
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
