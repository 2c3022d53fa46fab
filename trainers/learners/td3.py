"""TD3 for all UAVs (Fujimoto, van Hoof and Meger 2018, ICML)."""

from collections.abc import Mapping
from typing import Annotated, Any

import torch
from pydantic import Field
from pydantic.dataclasses import dataclass
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor
from torchrl.objectives import SoftUpdate, TD3Loss, group_optimizers

from emberlink.envs import keys
from emberlink.policies.exploration import OrnsteinUhlenbeck
from emberlink.policies.networks.actor_critic import STATE_ACTION_VALUE, TAKEN, make_critic
from emberlink.trainers.learners.base import (
    STRICT,
    Count,
    Learner,
    LearnerContext,
    Losses,
    NotNegative,
    mean_over_batch,
)
from emberlink.trainers.learners.ddpg import DDPGConfig
from emberlink.trainers.learners.replay import DONE, TERMINATED, TeamReplay, to_batch, to_rows

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


class TD3(Learner):
    """Updates the actor and two critics of each UAV, with target smoothing and delayed actors."""

    config_type = TD3Config

    def __init__(self, config: TD3Config, context: LearnerContext):
        self.config, self.context = config, context
        # Networks of all UAVs, stacked, with weights per UAV or shared.
        specs, policy = (context.observation_spec, context.action_spec), context.policy
        initial = torch.Generator().manual_seed(context.seed)
        self.actor = self.make_actor(config, *specs, initial, policy)
        shape: dict[str, Any] = {
            "share_parameters": config.share_parameters,
            "agent_index": policy.agent_index,
            "team": config.critic == "team",
        }
        critics = [make_critic(*specs, config.hidden, **shape, generator=initial) for _ in range(2)]
        # Exploration.
        self.generator = torch.Generator(context.device).manual_seed(context.seed)
        noise = OrnsteinUhlenbeck(config.exploration, context.num_uavs, self.generator)
        modules: list[Any] = [self.actor, noise]
        self.explorer = TensorDictSequential(*modules)
        # Losses and target networks. A list of critics, or TorchRL draws weights itself.
        bounds: Any = (-1.0, 1.0)
        loss = TD3Loss(
            SmoothedActor(self.actor, critics[0]),  # pyright: ignore[reportArgumentType]
            critics,
            bounds=bounds,
            policy_noise=0.0,  # TorchRL's noise is of the global generator; `update` draws it
            noise_clip=0.0,
            loss_function="l2",
            reduction="none",
            deactivate_vmap=True,
        )
        loss.set_keys(
            action=keys.ACTION,
            state_action_value=STATE_ACTION_VALUE,
            reward=keys.REWARD,
            done=DONE,
            terminated=TERMINATED,
        )
        loss.make_value_estimator(gamma=config.gamma)
        self.loss, self.targets = loss, SoftUpdate(loss, tau=config.tau)
        # Optimizer.
        actor_weights = list(loss.actor_network_params.values(True, True))
        critic_weights = list(loss.qvalue_network_params.values(True, True))
        decay = config.critic_weight_decay
        self.optimizer = group_optimizers(
            torch.optim.Adam(actor_weights, lr=config.actor_lr, fused=True),
            torch.optim.Adam(critic_weights, lr=config.critic_lr, weight_decay=decay, fused=True),
        )
        # Replay buffer.
        self.replay = TeamReplay(
            context,
            self.generator,
            batch_size=config.batch_size,
            buffer_size=config.buffer_size,
            joint=config.critic == "team",
            # A shared network learns from all UAVs anyway, and its input is the index of a column.
            mixed=not (config.share_parameters and policy.agent_index),
        )

    def learn(self, rollout: TensorDictBase) -> list[Losses]:
        """Stores a rollout, and performs updates if there is a full batch."""
        self.replay.extend(to_rows(rollout, self.context))
        if not self.replay.ready:
            return []
        updates = range(self.config.updates_per_step)
        return [self.update(to_batch(self.replay.sample())) for _ in updates]

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

    def start_from(self, weights: Mapping[str, Tensor]) -> None:
        """Begins with the actors of another run, and target actors like them."""
        self.copy_actor(weights)
        self.targets = SoftUpdate(self.loss, tau=self.config.tau)


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
