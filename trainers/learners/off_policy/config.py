"""Defines the settings of learners with a replay buffer and target networks."""

from typing import Annotated, Literal

from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from emberlink.envs.utils.errors import UserError
from emberlink.policies.exploration import ExplorationConfig
from emberlink.trainers.learners.anchor import WarmStartConfig
from emberlink.trainers.learners.base import STRICT, Count, NotNegative, Positive


@dataclass(frozen=True, kw_only=True, config=STRICT)
class OffPolicyConfig(WarmStartConfig):
    """Stores the settings of learners with a replay buffer and target networks."""

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
    """transitions per update and UAV; with a memory, rounded up to whole sequences"""
    buffer_size: Count
    """capacity of a replay buffer, in transitions of a UAV"""
    sequence: Count = 16
    """successive decisions that networks with a memory learn from"""
    burn_in: Annotated[int, Field(ge=0, le=1_000_000)] = 16
    """decisions before them, which prepare the memory and are not learnt from"""
    critic: Literal["own", "team"] = "own"
    """what a critic reads: the observation and action of its UAV (own), or of all UAVs (team)"""
    exploration: ExplorationConfig
    """exploration noise"""

    @model_validator(mode="after")
    def _a_batch_fits(self) -> "OffPolicyConfig":
        if self.batch_size > self.buffer_size:
            raise UserError(
                f"batch_size={self.batch_size} is larger than buffer_size={self.buffer_size}"
            )
        return self
