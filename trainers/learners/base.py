"""Defines what a learner is: its configuration, what it is built for, and what a training calls."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass as plain_dataclass
from typing import Annotated, Any, ClassVar

import torch
from pydantic import ConfigDict, Field, Strict
from pydantic.dataclasses import dataclass
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor
from torchrl.data import Composite

from emberlink.envs.utils.validation import Name
from emberlink.policies.networks import Generators, make_actor
from emberlink.trainers.learners.nan_guard import NonFiniteGuard

STRICT = ConfigDict(extra="forbid", strict=True)

Positive = Annotated[float, Field(gt=0, le=1e30)]
NotNegative = Annotated[float, Field(ge=0, le=1e30)]
Count = Annotated[int, Field(ge=1, le=1_000_000_000)]
Units = Annotated[int, Field(ge=1, le=8192)]

Losses = dict[str, Tensor]
"""the losses of one update by name, one number per UAV of all seeds, detached"""

ACTOR = "actor_network_params.module."
"""begins the names of the actors' weights in `Learner.weights`"""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class LearnerConfig:
    """The settings that every learner has; a learner's own config inherits them."""

    name: Name
    """the learner: a file in trainers/learners, or an entry point of `emberlink.learners`"""
    hidden: Annotated[tuple[Units, ...], Field(min_length=1, max_length=8), Strict(False)]
    """units of the hidden layers, 1 to 8 layers"""
    share_parameters: bool = False
    """one set of weights for all UAVs of a seed instead of one per UAV"""


@plain_dataclass(frozen=True, kw_only=True)
class LearnerContext:
    """What a learner is built for."""

    observation_spec: Composite
    """of the environments, batch size [seeds * num_envs]"""
    action_spec: Composite
    """likewise"""
    num_uavs: int
    """UAVs of a seed's team"""
    num_envs: int
    """environments of a seed; those of the first seed come first"""
    seeds: tuple[int, ...]
    """the seeds that train side by side; they share no parameters and no transitions"""
    shared_replay: bool
    """whether UAVs of a team learn from each other's transitions"""
    total_steps: int
    """steps of all environments in the whole run"""
    guard: NonFiniteGuard
    """to be told each update's batch, losses and gradients"""
    device: str
    """where networks and transitions live"""


class Learner(ABC):
    """Trains the networks of all UAVs, of one seed or of several side by side.

    A subclass in a file of its own, `trainers/learners/<name>.py`, is a new learner; its defaults
    are in `configs/learner/<name>.yaml`. It owns the networks, how they are updated, the
    transitions it learns from, the exploration policy, its named losses and its state.

    Args:
        config: an instance of `config_type`.
        context: what it is built for.
    """

    config_type: ClassVar[type[LearnerConfig]]
    actor: TensorDictModule
    """the actors of all UAVs, without noise"""
    explorer: TensorDictModuleBase
    """the policy that collects transitions"""
    rollout_steps: int = 1
    """steps of all environments that `learn` is given at once; divides the horizon"""
    learning_starts: int = 0
    """steps of all environments before the first update"""
    updates: int = 0
    """updates made so far"""

    @abstractmethod
    def __init__(self, config: Any, context: LearnerContext): ...

    @classmethod
    def make_actor(
        cls,
        config: Any,
        observation_spec: Composite,
        action_spec: Composite,
        generator: Generators = None,
    ) -> TensorDictModule:
        """Returns new actors; several generators make those of as many seeds."""
        return make_actor(
            observation_spec,
            action_spec,
            config.hidden,
            share_parameters=config.share_parameters,
            generator=generator,
        )

    @abstractmethod
    def learn(self, rollout: TensorDictBase) -> list[Losses]:
        """Learns from a rollout, batch size [seeds * num_envs, rollout_steps].

        Returns:
            The losses of each update that was made; none if there was none.
        """

    @abstractmethod
    def update(self, batch: TensorDictBase) -> Losses:
        """Makes one update from a batch as the guard has recorded it."""

    @abstractmethod
    def scale_lr(self, scale: float) -> None:
        """Sets all learning rates to the configuration's times a factor."""

    @abstractmethod
    def weights(self, team: int = 0) -> dict[str, Tensor]:
        """Returns the weights of one seed's networks by name, detached.

        Those of the actors are called `ACTOR` and then as in `make_actor`'s network.
        """

    @abstractmethod
    def state_dict(self, *, transitions: bool = True) -> dict[str, Tensor]:
        """Returns everything that learning changes, by name.

        Args:
            transitions: whether those that it learns from are included.
        """

    @abstractmethod
    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restores what `state_dict` gave, with or without transitions.

        Raises:
            ValueError: the state is not one of this configuration.
        """


def generators(seeds: tuple[int, ...]) -> list[torch.Generator]:
    """Returns the generators of the initial weights, one per seed."""
    return [torch.Generator().manual_seed(seed) for seed in seeds]
