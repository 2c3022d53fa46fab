"""Defines the base class of learners, its configuration and its context."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass as plain_dataclass
from dataclasses import field
from typing import Annotated, Any, ClassVar

import torch
from pydantic import Field, Strict
from pydantic.dataclasses import dataclass
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.data import Composite

from emberlink.envs.config import WildfireConfig
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.plugins import Plugins
from emberlink.envs.utils.validation import STRICT, Name
from emberlink.policies.networks.actor_critic import make_actor
from emberlink.policies.networks.messages import message_lag
from emberlink.policies.settings import PolicyConfig
from emberlink.trainers.learners.tensors import (
    copy_into,
    flatten,
    group,
    load_optimizer,
    optimizer_tensors,
    prefixed,
    unflatten,
)

Positive = Annotated[float, Field(gt=0, le=1e30)]
NotNegative = Annotated[float, Field(ge=0, le=1e30)]
Count = Annotated[int, Field(ge=1, le=1_000_000_000)]
Units = Annotated[int, Field(ge=1, le=8192)]

Losses = dict[str, Tensor]
"""losses of an update by name, detached, one number per UAV"""

ACTOR = "actor_network_params.module."
"""prefix of the names of the actors' weights in `Learner.weights`"""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class LearnerConfig:
    """Stores the settings of all learners; the configuration of a learner inherits from it."""

    name: Name
    """name of a learner of trainers/learners, or of an entry point of `emberlink.learners`"""
    hidden: Annotated[tuple[Units, ...], Field(min_length=1, max_length=8), Strict(False)]
    """units of the hidden layers, 1 to 8 layers"""
    share_parameters: bool = False
    """whether all UAVs use the same weights; if not, each UAV has its own"""

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
    """observation spec of the environments, batch size [num_envs]"""
    action_spec: Composite
    """action spec of the environments, batch size [num_envs]"""
    num_uavs: int
    """UAVs per environment"""
    num_envs: int
    """environments"""
    seed: int
    """seed of initial weights, exploration and batches"""
    shared_replay: bool
    """whether UAVs of a team learn from each other's transitions"""
    total_steps: int
    """decisions of the batch of environments in the whole run; steps if actions are not held"""
    device: str
    """device of networks and transitions"""
    policy: PolicyConfig = field(default_factory=PolicyConfig)
    """the policies' memory and inputs"""
    world: WildfireConfig = field(default_factory=WildfireConfig)
    """the world and the team"""
    horizon: int = 1000
    """decisions of an episode; steps if actions are not held"""
    failures: bool = False
    """whether UAVs can fail; losses leave out decisions after a failure, and if they use rewards,
    the decision of the failure"""

    @property
    def lag(self) -> int:
        """Decisions from saying a learned message to hearing it."""
        return message_lag(self.policy, self.world.radio)


class Learner(ABC):
    """Trains the networks of all UAVs.

    A learner owns the networks, their updates, the transitions that it learns from, and the
    exploration policy. A subclass sets `actor`, `loss` and `optimizer`, a `generator` if it draws
    random numbers after `__init__`, `replay` if it has a replay buffer, and `recent` if it learns
    from whole sequences; these are saved. Other state is added by the subclass's `state_dict` and
    `load_state_dict`.
    """

    config_type: ClassVar[type[LearnerConfig]]
    config: Any
    context: LearnerContext
    actor: Any
    """the actors of all UAVs, without exploration noise, a TensorDict module with the networks in
    `module`"""
    explorer: TensorDictModuleBase
    """the policy that collects transitions"""
    loss: Any
    """TorchRL's loss or another module that holds all networks; its state is saved"""
    optimizer: torch.optim.Optimizer
    """of all parameters that are trained"""
    generator: torch.Generator | None = None
    """draws exploration, batches and everything else after `__init__`"""
    replay: Any = None
    """the replay buffer, if there is one; its state is saved"""
    rollout_steps: int = 1
    """decisions of the batch of environments per call of `learn`; must divide the horizon"""
    recent: Any = ()
    """time steps that no update has used yet, batch size [environments, steps] each"""
    decisions: int = 0
    """decisions of the batch of environments so far, if the learner counts them"""
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
        generator: torch.Generator | None = None,
        policy: PolicyConfig | None = None,
        lag: int = 0,
    ) -> Any:
        """Returns new actors, whose messages are `lag` decisions late.

        Raises:
            UserError: the policy has a memory or messages, and the networks have none.
        """
        policy = policy or PolicyConfig()
        for key, value in (("memory", policy.memory), ("message", policy.message)):
            if value != "none":
                raise UserError(
                    f"policy.{key}={value}: the networks of learner={config.name} have none; those "
                    "of ippo and mappo have"
                )
        return make_actor(
            observation_spec,
            action_spec,
            config.hidden,
            share_parameters=config.share_parameters,
            agent_index=policy.agent_index,
            generator=generator,
        )

    def precision(self) -> torch.autocast:
        """Returns the context of a loss, for learners with the setting `bfloat16`."""
        device = torch.device(self.context.device).type
        return torch.autocast(device, torch.bfloat16, enabled=self.config.bfloat16)

    @abstractmethod
    def learn(self, rollout: TensorDictBase) -> list[Losses]:
        """Learns from a rollout, batch size [num_envs, rollout_steps].

        Where actions are held for several steps, a transition leads from one decision to the next.

        Returns:
            The losses of each update; an empty list if there was no update.
        """

    def start_from(self, weights: Mapping[str, Tensor]) -> None:
        """Begins the run with the actors of another run, from its `weights`."""
        raise UserError(f"learner.warm_start: learner={type(self).__name__} has no warm start")

    def copy_actor(self, weights: Mapping[str, Tensor]) -> None:
        """Copies weights, from `weights`, into the actors."""
        network = self.actor.module
        copy_into(network.state_dict(), {k: weights[ACTOR + k] for k in network.state_dict()})

    def weights(self) -> dict[str, Tensor]:
        """Returns the actors' weights by name, detached: `ACTOR` and the name in the network."""
        return {ACTOR + name: value for name, value in self.actor.module.state_dict().items()}

    def state_dict(self) -> dict[str, Tensor]:
        """Returns the state that learning changes, by name."""
        generator = {} if self.generator is None else {"state": self.generator.get_state()}
        replay = {} if self.replay is None else self.replay.state_dict()
        recent: Any = torch.cat(self.recent, 1) if self.recent else TensorDict({})  # pyright: ignore[reportArgumentType, reportCallIssue]
        counters = {"updates": self.updates, "decisions": self.decisions}
        return prefixed(
            replay=replay,
            weights=self.weights(),
            networks=self._other_networks(),
            optimizer=optimizer_tensors(self.optimizer),
            counters={name: torch.tensor(count) for name, count in counters.items()},
            recent=flatten(recent),
            generator=generator,
        )

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restores the state of `state_dict`.

        Raises:
            ValueError: the state does not fit this configuration.
        """
        self.copy_actor(group(state, "weights"))
        copy_into(self._other_networks(), group(state, "networks"))
        load_optimizer(self.optimizer, group(state, "optimizer"))
        self.updates = int(state["counters/updates"])
        self.decisions = int(state["counters/decisions"])
        if recent := group(state, "recent"):
            device = next(iter(self.weights().values())).device
            self.recent = list(unflatten(recent, 2, device).split(1, 1))
        if self.generator is not None:
            self.generator.set_state(state["generator/state"].cpu())
        if self.replay is not None:
            self.replay.load_state_dict(group(state, "replay"))

    def _other_networks(self) -> dict[str, Tensor]:
        """Returns the tensors of the loss by name, without the actors' weights."""
        actors = {value.data_ptr() for value in self.weights().values()}
        state = {k: v for k, v in self.loss.state_dict().items() if isinstance(v, Tensor)}
        return {name: value for name, value in state.items() if value.data_ptr() not in actors}


LEARNERS = Plugins(Learner, "emberlink.learners", "learner.name")


def mean_over_batch(loss: Tensor, alive: Tensor | None) -> Tensor:
    """Returns the mean loss of each UAV, [uavs], over the decisions in which it flew.

    It is not averaged over UAVs: gradients would shrink with their number.

    Args:
        loss: [..., uavs].
        alive: bool of the same shape; None if UAVs do not fail.
    """
    loss = loss.flatten(0, -2)
    if alive is None:
        return loss.mean(0)
    weight = alive.flatten(0, -2).to(loss.dtype)
    return (loss * weight).sum(0) / weight.sum(0).clamp(min=1)
