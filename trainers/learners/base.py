"""Defines the base class of learners, its configuration and its context."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass as plain_dataclass
from dataclasses import field
from typing import Annotated, Any, ClassVar

import torch
from pydantic import Field, Strict
from pydantic.dataclasses import dataclass
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.data import Composite

from emberlink.envs.config import WildfireConfig
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import STRICT, Name
from emberlink.policies.networks import Generators, make_actor, team_of
from emberlink.policies.settings import PolicyConfig
from emberlink.trainers.learners.nan_guard import NonFiniteGuard

Positive = Annotated[float, Field(gt=0, le=1e30)]
NotNegative = Annotated[float, Field(ge=0, le=1e30)]
Count = Annotated[int, Field(ge=1, le=1_000_000_000)]
Units = Annotated[int, Field(ge=1, le=8192)]

Losses = dict[str, Tensor]
"""losses of an update by name, detached, one number per UAV of all seeds"""

ACTOR = "actor_network_params.module."
"""prefix of the names of the actors' weights in `Learner.weights`"""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class LearnerConfig:
    """Stores the settings of all learners; the configuration of a learner inherits from it."""

    name: Name
    """name of a file in trainers/learners, or of an entry point of `emberlink.learners`"""
    hidden: Annotated[tuple[Units, ...], Field(min_length=1, max_length=8), Strict(False)]
    """units of the hidden layers, 1 to 8 layers"""
    share_parameters: bool = False
    """whether all UAVs of a seed use the same weights; if not, each UAV has its own"""

    @property
    def replays(self) -> bool:
        """Whether the learner has a replay buffer, which the UAVs may share."""
        return True

    @property
    def reads_map(self) -> bool:
        """Whether the learner reads the true map of the fire, `keys.TRUE_MAP`, in training."""
        return False

    @property
    def reads_teacher(self) -> str | None:
        """The scripted policy whose actions, `keys.TEACHER`, it learns from; None for none."""
        return None


@plain_dataclass(frozen=True, kw_only=True)
class LearnerContext:
    """The environment and the run that a learner is built for."""

    observation_spec: Composite
    """observation spec of the environments, batch size [seeds * num_envs]"""
    action_spec: Composite
    """action spec of the environments, batch size [seeds * num_envs]"""
    num_uavs: int
    """UAVs per environment"""
    num_envs: int
    """environments per seed; those of the first seed come first"""
    seeds: tuple[int, ...]
    """seeds that are trained in parallel; they share no weights and no transitions"""
    shared_replay: bool
    """whether UAVs of a team learn from each other's transitions"""
    total_steps: int
    """decisions of the batch of environments in the whole run; steps if actions are not held"""
    guard: NonFiniteGuard
    """checks the batch, losses and gradients of each update"""
    device: str
    """device of networks and transitions"""
    policy: PolicyConfig = field(default_factory=PolicyConfig)
    """the policies' memory and inputs"""
    world: WildfireConfig = field(default_factory=WildfireConfig)
    """the world and the team"""
    horizon: int = 1000
    """decisions of an episode; steps if actions are not held"""
    failures: bool = False
    """whether UAVs can fail; losses leave out decisions after a failure, and those that use rewards
    also the decision during which it happens"""


class Learner(ABC):
    """Trains the networks of all UAVs, for one seed or several in parallel.

    A subclass in its own file, `trainers/learners/<name>.py`, is a new learner; its defaults are in
    `configs/learner/<name>.yaml`. It owns the networks, their updates, the transitions that it
    learns from, and the exploration policy.

    Args:
        config: an instance of `config_type`.
        context: environment and run.
    """

    config_type: ClassVar[type[LearnerConfig]]
    actor: Any
    """the actors of all UAVs, without exploration noise, a TensorDict module with the networks in
    `module`"""
    explorer: TensorDictModuleBase
    """the policy that collects transitions"""
    rollout_steps: int = 1
    """decisions of the batch of environments per call of `learn`; must divide the horizon"""
    learning_starts: int = 0
    """decisions of the batch of environments before the first update"""
    updates: int = 0
    """updates made so far"""
    teams: int
    """seeds that are trained in parallel"""

    @abstractmethod
    def __init__(self, config: Any, context: LearnerContext): ...

    @classmethod
    def make_actor(
        cls,
        config: Any,
        observation_spec: Composite,
        action_spec: Composite,
        generator: Generators = None,
        policy: PolicyConfig | None = None,
    ) -> Any:
        """Returns new actors for as many seeds as there are generators.

        Raises:
            UserError: the policy has a memory, and the networks have none.
        """
        policy = policy or PolicyConfig()
        if policy.memory != "none":
            raise UserError(
                f"policy.memory={policy.memory}: the networks of learner={config.name} have none"
            )
        return make_actor(
            observation_spec,
            action_spec,
            config.hidden,
            share_parameters=config.share_parameters,
            policy=policy,
            generator=generator,
        )

    def team_actor(self, team: int, teams: int) -> Any:
        """Returns the actors of one of several seeds without noise; they share memory with `actor`.

        A learner with networks that `make_actor` does not make overrides it to train several seeds
        in parallel.

        Raises:
            UserError: the networks of a seed cannot be told apart.
        """
        if teams > 1 and not hasattr(self.actor.module, "grouping"):
            raise UserError(
                f"seeds: {type(self).__name__} trains one seed at a time; its networks are not "
                "those of make_actor, and it has no team_actor of its own"
            )
        return team_of(self.actor, team, teams)

    @abstractmethod
    def learn(self, rollout: TensorDictBase) -> list[Losses]:
        """Learns from a rollout, batch size [seeds * num_envs, rollout_steps].

        Where actions are held for several steps, a transition leads from one decision to the next
        (`policies.hold.decisions`).

        Returns:
            The losses of each update; an empty list if there was no update.
        """

    @abstractmethod
    def update(self, batch: TensorDictBase) -> Losses:
        """Performs one update with a batch that the guard recorded."""

    def start_from(self, weights: Mapping[str, Tensor]) -> None:
        """Begins the run with the actors of another run, in all seeds.

        Args:
            weights: the weights of one seed's actors by name, as those of `weights`.

        Raises:
            UserError: the learner has no warm start.
            ValueError: a weight is missing or has another shape.
        """
        raise UserError(f"learner.warm_start: learner={type(self).__name__} has no warm start")

    @abstractmethod
    def scale_lr(self, scale: float) -> None:
        """Sets all learning rates to those of the configuration times a factor."""

    @abstractmethod
    def networks(self) -> dict[str, Tensor]:
        """Returns the weights of all seeds' networks by name, not copied: [seeds * k, ...] each.

        In some, the dimension of seeds and UAVs is another one, see `stack_dim`. The names of the
        actors' weights are `ACTOR` and the name in the network of `make_actor`.
        """

    def stack_dim(self, name: str) -> int:
        """Returns the dimension of a weight of `networks` that stacks the seeds and their UAVs."""
        return 0

    def weights(self, team: int = 0) -> dict[str, Tensor]:
        """Returns the weights of one seed's networks by name, detached.

        They have the shapes of `networks`, with k instead of seeds * k.
        """
        weights: dict[str, Tensor] = {}
        for name, value in self.networks().items():
            dim = self.stack_dim(name)
            stacked = value.detach().unflatten(dim, (self.teams, -1))
            weights[name] = stacked.select(dim, team)
        return weights

    @abstractmethod
    def state_dict(self, *, transitions: bool = True) -> dict[str, Tensor]:
        """Returns the state that learning changes, by name.

        Args:
            transitions: whether to include the replay buffer's transitions.
        """

    @abstractmethod
    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restores the state of `state_dict`, with or without transitions.

        Raises:
            ValueError: the state does not fit this configuration.
        """


def copy_to_seeds(network: torch.nn.Module, weights: Mapping[str, Tensor], teams: int) -> None:
    """Copies the actors of one seed, as in `Learner.weights`, to all seeds of a network."""
    with torch.no_grad():
        for name, place in network.state_dict().items():
            place.unflatten(0, (teams, -1)).copy_(weights[ACTOR + name])


def generators(seeds: tuple[int, ...]) -> list[torch.Generator]:
    """Returns a generator of initial weights for each seed."""
    return [torch.Generator().manual_seed(seed) for seed in seeds]
