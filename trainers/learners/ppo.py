"""PPO (Schulman et al. 2017) for all UAVs, from the episodes of an iteration: IPPO and MAPPO.

IPPO's critic reads its UAV's observation (de Witt et al. 2020), MAPPO's the observations of the
team (Yu et al. 2022, NeurIPS). The losses and the advantages are TorchRL's `MAPPOLoss` and
`MultiAgentGAE`; its standardisation of advantages and its `ValueNorm` are not used, since both
count decisions after the failure of a UAV. A memory learns from chunks of an episode, each from the
state that was stored at its beginning (Yu et al. 2022, appendix A); so do late messages: those in
flight when a chunk begins are constants, as they were said.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any

import torch
from pydantic import Field
from pydantic.dataclasses import dataclass
from tensordict import TensorDict, TensorDictBase, pad
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
)
from torch import Tensor
from torchrl.data import Composite
from torchrl.modules import IndependentNormal

from emberlink.envs import keys
from emberlink.policies.gaussian import LOG_PROB, MEAN, MEMORY, GaussianActor, GaussianExplorer
from emberlink.policies.networks.sequence import GaussianNetwork, SequenceNetwork, TeamNetwork
from emberlink.policies.settings import PolicyConfig
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

VALUE = (keys.AGENTS, "state_value")
"""float32 [..., 1]: the critics' output, in units of the returns' standard deviation"""
ADVANTAGE = (keys.AGENTS, "advantage")
"""float32 [..., 1]: standardised"""
RETURN = (keys.AGENTS, "value_target")
"""float32 [..., 1], in units of the returns' standard deviation"""
ACTOR_STATE, CRITIC_STATE = "actor_state", "critic_state"
"""float32 [..., size]: states of the memories before a chunk"""
_STD, _ENDS, _TERMINATED = (keys.AGENTS, "std"), (keys.AGENTS, "ends"), (keys.AGENTS, "terminated")
_KEPT = 0.9
"""share of the earlier spread of the returns that is kept from episode to episode"""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class IPPOConfig(LearnerConfig):
    """Stores the settings of IPPO."""

    share_parameters: bool = True
    """whether all UAVs use the same weights; if not, each UAV has its own"""
    gamma: Annotated[float, Field(ge=0, lt=1)]
    """discount per decision"""
    gae_lambda: Annotated[float, Field(ge=0, le=1)]
    """factor of generalised advantage estimation (Schulman et al. 2016), per decision"""
    clip: Annotated[float, Field(gt=0, lt=1)]
    """clip range of the probability ratio, [1 - clip, 1 + clip]"""
    epochs: Count
    """passes over the episodes of an iteration"""
    minibatches: Count
    """updates of a pass, each from other chunks"""
    chunk: Annotated[int, Field(ge=0, le=1_000_000)] = 0
    """successive decisions through which gradients of a memory, and of late messages, flow; 0 for
    whole episodes"""
    lr: Positive
    """learning rate of Adam at the beginning; it falls linearly to 0 at the end of the run"""
    gradient_norm: Positive
    """largest Euclidean norm of the gradient of a network"""
    bfloat16: bool = False
    """whether updates compute with numbers of 16 bits where these suffice (`torch.autocast`)"""
    entropy: NotNegative
    """weight of the entropy of the actions in the actors' loss"""
    log_std: Annotated[float, Field(ge=-10, le=2)] = -0.5
    """logarithm of the standard deviation of the actions at the beginning, also of a warm start"""
    warm_start: str = ""
    """run folder, or `pretrained:…`, whose actors the run begins with; none if empty"""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class MAPPOConfig(IPPOConfig):
    """Stores the settings of MAPPO."""

    critic_map: bool = False
    """whether the critic, in training, reads the true map instead of windows and pictures: the
    shares of seen and unseen burning cells in squares"""

    @property
    def reads_map(self) -> bool:
        return self.critic_map


class PPO(Learner, ABC):
    """Updates actors and critics after each episode, from the episode of every environment.

    IPPO and MAPPO define the critics.
    """

    def __init__(self, config: Any, context: LearnerContext):
        self.config, self.context = config, context
        # Imported here, as torchrl 0.11, with which policies fly in BenchMARL, does not have them.
        from torchrl.objectives.value import MultiAgentGAE

        # Networks.
        specs = context.observation_spec, context.action_spec
        initial = torch.Generator().manual_seed(context.seed)
        self.actor = self.make_actor(config, *specs, initial, context.policy, context.lag)
        self.critic: Any = self.make_critic(context, initial)
        self._reset_std()
        self.chunk = min(config.chunk or context.horizon, context.horizon)
        """decisions of a chunk; the last one of an episode may have fewer"""
        # Exploration.
        self.generator = torch.Generator(context.device).manual_seed(context.seed)
        self.explorer = GaussianExplorer(self.actor, self.generator)
        # Losses and advantages.
        self.loss = self._make_loss()
        self.gae = MultiAgentGAE(
            gamma=config.gamma,
            lmbda=config.gae_lambda,
            value_network=None,
            average_gae=False,
            device=torch.device(context.device),
        )
        self.gae.set_keys(
            advantage=ADVANTAGE,
            value_target=RETURN,
            value=VALUE,
            reward=keys.REWARD,
            done=_ENDS,
            terminated=_TERMINATED,
        )
        networks = 1 if config.share_parameters else context.num_uavs
        self.spread = torch.zeros(networks, device=context.device)
        """standard deviation of the returns of each network's UAVs, averaged over iterations; the
        unit of the critics' values; 0 before the first iteration"""
        self.loss.register_buffer("spread", self.spread)  # saved with it
        # Optimizer.
        self.parts = [list(part.module.parameters()) for part in (self.actor, self.critic)]
        weights = [*self.parts[0], *self.parts[1]]
        self.optimizer = torch.optim.Adam(weights, lr=config.lr, eps=1e-5, fused=True)
        # Several decisions at once cost less; a whole episode would fill the memory twice.
        self.rollout_steps = max(n for n in range(1, 11) if context.horizon % n == 0)
        self.recent = []  # transitions of the current episode

    @classmethod
    def make_actor(
        cls,
        config: Any,
        observation_spec: Composite,
        action_spec: Composite,
        generator: torch.Generator | None = None,
        policy: PolicyConfig | None = None,
        lag: int = 0,
    ) -> GaussianActor:
        """Returns new actors, with a memory if the policy has one."""
        uavs, actions = action_spec[keys.ACTION].shape[-2:]
        device: Any = observation_spec.device
        network = GaussianNetwork(
            uavs,
            keys.observation_shapes(observation_spec),
            actions,
            config.hidden,
            policy=policy or PolicyConfig(),
            share_parameters=config.share_parameters,
            lag=lag,
            device=device,
            generator=generator,
        )
        return GaussianActor(network, observation_spec)

    @abstractmethod
    def make_critic(self, context: LearnerContext, generator: torch.Generator) -> TensorDictModule:
        """Returns new critics, which read `CRITIC_STATE` first and write `VALUE` for chunks."""

    def _make_loss(self) -> Any:
        from torchrl.objectives.multiagent import MAPPOLoss

        outputs: list[Any] = [MEAN, _STD]
        draw = ProbabilisticTensorDictModule(
            in_keys={"loc": MEAN, "scale": _STD},  # pyright: ignore[reportArgumentType]
            out_keys=[keys.ACTION],
            distribution_class=IndependentNormal,
        )
        reads: list[Any] = [ACTOR_STATE, *self.actor.observed]
        actor = TensorDictModule(self.actor.module, in_keys=reads, out_keys=outputs)
        policy: list[Any] = [actor, draw]
        loss = MAPPOLoss(
            ProbabilisticTensorDictSequential(*policy),
            self.critic,
            clip_epsilon=self.config.clip,
            entropy_bonus=self.config.entropy > 0,
            entropy_coeff=self.config.entropy,
            normalize_advantage=False,
            loss_critic_type="l2",
            log_explained_variance=False,
            functional=False,
            reduction="none",
            device=torch.device(self.context.device),
        )
        loss.set_keys(
            action=keys.ACTION,
            sample_log_prob=LOG_PROB,
            advantage=ADVANTAGE,
            value_target=RETURN,
            value=VALUE,
        )
        return loss

    def learn(self, rollout: TensorDictBase) -> list[Losses]:
        """Stores a rollout, and makes all updates of an iteration at the end of an episode."""
        self.recent.append(self._transitions(rollout))
        self.decisions += rollout.shape[1]
        if self.decisions % self.context.horizon:
            return []
        episode: Any = torch.cat(self.recent, 1)  # pyright: ignore[reportArgumentType]
        self.recent = []
        states = self._estimate(episode, rollout.get("next")[:, -1:])
        chunks = self._chunks(episode, states)
        done = (self.decisions - self.context.horizon) / self.context.total_steps
        for entry in self.optimizer.param_groups:
            entry["lr"] = self.config.lr * max(0.0, 1 - done)
        return [self.update(batch) for batch in self._batches(chunks)]

    def _transitions(self, rollout: TensorDictBase) -> TensorDict:
        """Returns the learner's tensors of a rollout, batch size [environments, steps]."""
        read = [*self.actor.observed, *self.critic.in_keys[1:], keys.ACTION, LOG_PROB]
        read += self.actor.carries  # the state of the memory before the decision
        result = {key: rollout.get(key) for key in read}
        result[keys.REWARD] = rollout.get(("next", *keys.REWARD))
        if self.context.failures:
            result[keys.ALIVE] = rollout.get(("next", *keys.ALIVE))
        return TensorDict(result, batch_size=rollout.shape, device=rollout.device)

    def _estimate(self, episode: TensorDictBase, last: TensorDictBase) -> Tensor:
        """Writes the advantages and returns of an episode; `last` is the time step after it.

        Returns:
            The states of the critics' memory before each chunk, [environments, chunks, ...].
        """
        read = [part.select(*self.critic.in_keys[1:]) for part in (episode, last)]
        whole: Any = torch.cat(read, 1)  # pyright: ignore[reportArgumentType]
        # Some environments at a time, to save memory.
        parts = [self._values(part) for part in whole.chunk(self.config.minibatches)]
        values, states = (torch.cat(of_parts) for of_parts in zip(*parts, strict=True))
        reward, alive = episode.pop(keys.REWARD), episode.get(keys.ALIVE, None)
        advantage, returns = self.advantages(values, reward, alive)
        episode.set(ADVANTAGE, advantage).set(RETURN, returns)
        return states

    @torch.no_grad()
    def _values(self, episode: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Returns values, [environments, decisions + 1, ...], and states before the chunks."""
        state, states, values = self.critic.module.empty_state(len(episode)), [], []
        for chunk in episode.split(self.chunk, 1):
            states.append(state)
            observed = [chunk.get(key) for key in self.critic.in_keys[1:]]
            value, state = self.critic.module(state, *observed)
            values.append(value)
        chunks = -(-self.context.horizon // self.chunk)  # the time step after them may be another
        return torch.cat(values, 1), torch.stack(states[:chunks], 1)

    def _chunks(self, episode: TensorDictBase, critic_states: Tensor) -> TensorDictBase:
        """Cuts an episode into chunks, batch size [environments * chunks].

        The last one is padded with decisions in which no UAV flies.
        """
        missing = -self.context.horizon % self.chunk
        if missing:
            flew = torch.ones_like(episode.get(LOG_PROB), dtype=torch.bool)
            episode.set(keys.ALIVE, episode.get(keys.ALIVE, flew))
            episode = pad(episode, [0, 0, 0, missing])
        chunks: Any = episode.reshape(-1, self.chunk)
        memory = chunks.pop(MEMORY, None)
        rows = len(chunks), self.context.num_uavs
        first = critic_states.new_zeros(*rows, 0) if memory is None else memory[:, 0]
        chunks.batch_size = rows[:1]
        return chunks.set(ACTOR_STATE, first).set(CRITIC_STATE, critic_states.flatten(0, 1))

    def advantages(
        self, value: Tensor, reward: Tensor, alive: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Returns advantages, standardised, and returns in units of the new `spread`.

        The horizon truncates an episode and does not end the world: the value of the last
        observation stands for what would follow. The episode of a UAV that fails is truncated
        before the decision that it does not survive.

        Args:
            value: float32 [envs, decisions + 1, uavs, 1], in units of the old `spread`.
            reward: float32 [envs, decisions, uavs, 1].
            alive: bool [envs, decisions, uavs], whether a UAV still flew after a decision; None if
                UAVs do not fail.
        """
        uavs = reward.shape[2] // len(self.spread)  # of a network

        def of_uavs(x: Tensor) -> Tensor:
            return x.repeat_interleave(uavs).unsqueeze(-1)

        value = value * of_uavs(torch.where(self.spread > 0, self.spread, 1.0))
        flew = torch.ones_like(reward, dtype=torch.bool) if alive is None else alive.unsqueeze(-1)
        ends = torch.cat((~flew[:, 1:], torch.ones_like(flew[:, :1])), 1)
        after = {VALUE: value[:, 1:], keys.REWARD: reward, _ENDS: ends}
        after[_TERMINATED] = torch.zeros_like(ends)
        batch = reward.shape[:2]
        episode = TensorDict({VALUE: value[:, :-1], "next": TensorDict(after, batch)}, batch)
        self.gae(episode)
        advantage, returns = episode.get(ADVANTAGE), episode.get(RETURN)
        mean, std = self._moments(advantage, flew)
        _, spread = self._moments(returns, flew)
        kept = (self.spread > 0).to(self.spread.dtype) * _KEPT
        self.spread.copy_(torch.lerp(spread, self.spread, kept).clamp(min=1e-6))
        advantage = (advantage - of_uavs(mean)) / of_uavs(std + 1e-8)
        return advantage, returns / of_uavs(self.spread)

    def _moments(self, x: Tensor, flew: Tensor) -> tuple[Tensor, Tensor]:
        """Returns mean and standard deviation for each network, over the decisions in flight."""
        weight = flew.to(x.dtype)
        shape, rest = (2, (len(self.spread), -1)), (0, 1, 3, 4)
        x, weight = x.unflatten(*shape), weight.unflatten(*shape)
        count = weight.sum(rest).clamp(min=1)
        mean = (x * weight).sum(rest) / count
        squares = (x - mean[:, None, None]).square() * weight
        return mean, (squares.sum(rest) / count).sqrt()

    def _batches(self, chunks: TensorDictBase) -> Iterator[TensorDictBase]:
        """Yields the batches of an iteration, [chunks, decisions] of each."""
        size, device = len(chunks), self.context.device
        for _ in range(self.config.epochs):
            order = torch.randperm(size, generator=self.generator, device=device)
            for chosen in order.tensor_split(min(self.config.minibatches, size)):
                yield chunks[chosen]

    def update(self, batch: TensorDictBase) -> Losses:
        """Performs one step of the optimizer on chunks."""
        with self.precision():
            losses = self.losses(batch)
        torch.stack([self._of_networks(*item) for item in losses.items()]).sum().backward()
        for part in self.parts:
            gradients = [value.grad for value in part if value.grad is not None]
            clip_by_row(gradients, self.config.gradient_norm)
        self.optimizer.step()
        self.optimizer.zero_grad()
        self.updates += 1
        return {name: value.detach() for name, value in losses.items()}

    def losses(self, batch: TensorDictBase) -> Losses:
        """Computes the losses with gradients, one number per UAV."""
        computed, alive = self.loss(batch.copy()), batch.get(keys.ALIVE, None)
        names = {"actor": "loss_objective", "critic": "loss_critic", "entropy": "loss_entropy"}
        return {
            name: mean_over_batch(computed.get(key), alive)
            for name, key in names.items()
            if key in computed.keys()  # noqa: SIM118  (a TensorDict iterates over its rows)
        }

    def _of_networks(self, name: str, loss: Tensor) -> Tensor:
        """Returns the sum of the losses of all networks, each the mean over its UAVs."""
        networks = len(self.parts[name == "critic"][0])
        return loss.unflatten(-1, (networks, -1)).mean(-1).sum()

    def start_from(self, weights: Mapping[str, Tensor]) -> None:
        self.copy_actor(weights)
        self._reset_std()

    def _reset_std(self) -> None:
        """Resets the standard deviation of the actions to `log_std`."""
        with torch.no_grad():
            self.actor.module.log_std.fill_(self.config.log_std)


class IPPO(PPO):
    """Values each UAV's observation."""

    config_type = IPPOConfig

    def make_critic(self, context: LearnerContext, generator: torch.Generator) -> TensorDictModule:
        observed: Any = keys.observation_keys(context.observation_spec)
        network = SequenceNetwork(
            context.num_uavs,
            keys.observation_shapes(context.observation_spec),
            1,
            self.config.hidden,
            policy=context.policy,
            gain=1.0,
            share_parameters=self.config.share_parameters,
            device=context.device,
            generator=generator,
        )
        return TensorDictModule(network, in_keys=[CRITIC_STATE, *observed], out_keys=[VALUE, "_"])


class MAPPO(PPO):
    """Values the observations and positions of the whole team, with one number for each UAV.

    With `critic_map`, it reads the true map, which no actor does, instead of windows and pictures.
    The critic has one set of weights and is used in training alone.
    """

    config_type = MAPPOConfig

    def make_critic(self, context: LearnerContext, generator: torch.Generator) -> TensorDictModule:
        spec, world = context.observation_spec, context.world
        observed: list[Any] = keys.observation_keys(spec)
        shapes = keys.observation_shapes(spec)
        if self.config.critic_map:  # the vectors, which come first
            observed, shapes = [observed[0], keys.TRUE_MAP], shapes[:1]
        network = TeamNetwork(
            context.num_uavs,
            shapes,
            world.low,
            world.high,
            hidden=self.config.hidden,
            policy=context.policy,
            gain=1.0,
            grid=world.grid if self.config.critic_map else None,
            device=context.device,
            generator=generator,
        )
        reads: list[Any] = [CRITIC_STATE, keys.POSITION, *observed]
        return TensorDictModule(network, in_keys=reads, out_keys=[VALUE, "_"])


def clip_by_row(gradients: Sequence[Tensor], limit: float) -> None:
    """Shortens the gradients of a network to a Euclidean norm, in place and per row.

    Args:
        gradients: [rows, ...] each; a row belongs to a UAV or, with shared weights, to the team.
        limit: largest norm of a row of all gradients together.
    """
    rows = [torch.linalg.vector_norm(gradient.flatten(1), dim=1) for gradient in gradients]
    factor = (limit / (torch.stack(rows).square().sum(0).sqrt() + 1e-6)).clamp(max=1)
    for gradient in gradients:
        gradient.mul_(factor.view(-1, *[1] * (gradient.ndim - 1)))
