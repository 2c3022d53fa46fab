"""DDPG for all UAVs (Lillicrap et al. 2016; paper, section III.C)."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import torch
from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import Tensor
from torchrl.objectives import DDPGLoss, SoftUpdate, group_optimizers

from emberlink.envs import keys
from emberlink.envs.utils.errors import UserError
from emberlink.policies.exploration import ExplorationConfig, OrnsteinUhlenbeck
from emberlink.policies.networks.actor_critic import STATE_ACTION_VALUE, TAKEN, make_critic
from emberlink.trainers.learners.base import (
    STRICT,
    Count,
    Learner,
    LearnerConfig,
    LearnerContext,
    Losses,
    NotNegative,
    Positive,
    mean_over_batch,
)
from emberlink.trainers.learners.replay import DONE, TERMINATED, TeamReplay, to_batch, to_rows


@dataclass(frozen=True, kw_only=True, config=STRICT)
class DDPGConfig(LearnerConfig):
    """Stores the settings of DDPG."""

    gamma: Annotated[float, Field(ge=0, lt=1)]
    """discount per decision"""
    actor_lr: Positive
    """learning rate of the actors' Adam"""
    critic_lr: Positive
    """learning rate of the critics' Adam"""
    critic_weight_decay: NotNegative
    """L2 penalty in the critics' Adam"""
    tau: Annotated[float, Field(gt=0, le=0.5)]
    """soft update of the target networks: target += tau * (network - target)"""
    updates_per_step: Count
    """updates of every UAV's networks per decision of the batch of environments"""
    batch_size: Annotated[int, Field(ge=1, le=1_000_000)]
    """transitions per update and UAV"""
    buffer_size: Count
    """capacity of a replay buffer, in transitions of a UAV"""
    critic: Literal["own", "team"] = "own"
    """inputs of a critic: observation and action of its UAV (own), or of all UAVs (team)"""
    exploration: ExplorationConfig
    """exploration noise"""
    warm_start: str = ""
    """run folder, or `pretrained:…`, whose actors the run begins with; none if empty"""

    @model_validator(mode="after")
    def _a_batch_fits(self) -> "DDPGConfig":
        if self.batch_size > self.buffer_size:
            raise UserError(
                f"batch_size={self.batch_size} is larger than buffer_size={self.buffer_size}"
            )
        return self


class DDPG(Learner):
    """Updates the actor, the critic and their target networks of each UAV from its own batch."""

    config_type = DDPGConfig

    def __init__(self, config: DDPGConfig, context: LearnerContext):
        self.config, self.context = config, context
        # Networks of all UAVs, stacked, with weights per UAV or shared.
        specs, policy = (context.observation_spec, context.action_spec), context.policy
        initial = torch.Generator().manual_seed(context.seed)
        self.actor = self.make_actor(config, *specs, initial, policy)
        critic = make_critic(
            *specs,
            config.hidden,
            share_parameters=config.share_parameters,
            agent_index=policy.agent_index,
            team=config.critic == "team",
            generator=initial,
        )
        # Exploration.
        self.generator = torch.Generator(context.device).manual_seed(context.seed)
        noise = OrnsteinUhlenbeck(config.exploration, context.num_uavs, self.generator)
        modules: list[Any] = [self.actor, noise]
        self.explorer = TensorDictSequential(*modules)
        # Losses and target networks.
        loss = DDPGLoss(self.actor, critic, delay_actor=True, delay_value=True, reduction="none")
        loss.set_keys(
            state_action_value=STATE_ACTION_VALUE,
            reward=keys.REWARD,
            done=DONE,
            terminated=TERMINATED,
        )
        loss.make_value_estimator(gamma=config.gamma)
        self.loss, self.targets = loss, SoftUpdate(loss, tau=config.tau)
        # Optimizer.
        actors = list(loss.actor_network_params.values(True, True))
        critics = list(loss.value_network_params.values(True, True))
        decay = config.critic_weight_decay
        self.optimizer = group_optimizers(
            torch.optim.Adam(actors, lr=config.actor_lr, fused=True),
            torch.optim.Adam(critics, lr=config.critic_lr, weight_decay=decay, fused=True),
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
        """Performs one step of the optimizers and the target networks on transitions, [batch]."""
        losses = self.losses(batch)
        torch.stack([*losses.values()]).sum().backward()
        self.optimizer.step()
        self.optimizer.zero_grad()
        self.targets.step()
        self.updates += 1
        return {name: value.detach() for name, value in losses.items()}

    def losses(self, batch: TensorDictBase) -> Losses:
        """Computes the losses with gradients, one number per UAV."""
        if self.config.critic == "team":
            batch = batch.copy().set(TAKEN, batch.get(keys.ACTION))
        losses, alive = self.loss(batch), batch.get(keys.ALIVE, None)
        return {
            "actor": mean_over_batch(losses["loss_actor"], alive),
            "critic": mean_over_batch(losses["loss_value"], alive),
        }

    def start_from(self, weights: Mapping[str, Tensor]) -> None:
        """Begins with the actors of another run, and target actors like them."""
        self.copy_actor(weights)
        self.targets = SoftUpdate(self.loss, tau=self.config.tau)
