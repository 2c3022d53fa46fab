"""What is trained: the environments, the learner and the collector of a configuration."""

from collections.abc import Mapping
from dataclasses import replace
from itertools import islice

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor

from emberlink.envs import keys
from emberlink.envs.utils.errors import UserError
from emberlink.policies.networks import team_of
from emberlink.trainers.build import build_env, build_learner
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.learners.nan_guard import NonFiniteGuard
from emberlink.trainers.learners.tensors import copy_into, flatten, group, prefixed, unflatten
from emberlink.trainers.rollout.allocator import keep_freed_memory
from emberlink.trainers.rollout.collector import make_collector
from emberlink.trainers.training.episode import EpisodeRecord


class TrainingSetup:
    """Everything that training changes, in memory: no file is read or written.

    With several seeds their environments lie side by side and their networks are one stack; nothing
    crosses from one seed to another. From then on the process keeps the memory that it frees (see
    `allocator`).

    Args:
        config: of the run.
    """

    def __init__(self, config: RunConfig):
        keep_freed_memory()
        self.config, self.horizon = config, config.env.horizon
        self.seeds = config.seeds or (config.seed,)
        self.teams = len(self.seeds)
        self.total_steps = config.episodes * self.horizon
        self.step = 0
        """steps of all environments so far"""
        self.env = build_env(
            config,
            num_envs=self.teams * config.num_envs,
            fire=config.fire,
            seed=self.seeds,
            device=config.device,
        )
        self.guard = NonFiniteGuard(config.device)
        self.learner = build_learner(config, self.env, self.guard)
        if self.horizon % self.learner.rollout_steps:
            raise UserError(
                f"env.horizon={self.horizon}: must be a multiple of the "
                f"{self.learner.rollout_steps} steps that the learner takes at once"
            )
        self.collector = make_collector(
            self.env,
            self.learner.explorer,
            horizon=self.horizon,
            total_steps=self.total_steps,
            rollout_steps=self.learner.rollout_steps,
        )
        self.record = EpisodeRecord(self.teams)
        observed = keys.observation_keys(self.env.observation_spec)
        following = [keys.POSITION, keys.REWARD, *observed]
        self._checked = [*observed, keys.ACTION, *(("next", *key) for key in following)]

    @property
    def episode(self) -> int:
        """Episodes that are finished."""
        return self.step // self.horizon

    def learn(self, rollout: TensorDictBase) -> None:
        """Checks a rollout, learns from it and records it."""
        steps = rollout.shape[1]
        self.step += steps
        self.guard.record_rollout(rollout.select(*self._checked), steps)
        self.record.add(rollout, self.learner.learn(rollout))

    def dry_run(self, steps: int) -> None:
        """Collects and learns for some steps; nothing is measured or written."""
        for rollout in islice(self.collector, -(-steps // self.learner.rollout_steps)):
            self.learn(rollout)

    def seed_config(self, team: int) -> RunConfig:
        """Returns the configuration of one of the seeds."""
        return replace(self.config, seed=self.seeds[team])

    def team_actor(self, team: int) -> TensorDictModule:
        """Returns the actors of one seed, without noise; they learn on with the others."""
        return team_of(self.learner.actor, team, self.teams)

    def state_dict(self) -> dict[str, Tensor]:
        """Returns everything that training has changed, "group/name" -> tensor, copied.

        What is missing follows from the configuration: fires, initial weights, and all random
        numbers, which are hashes of a seed and of counters that are included.
        """
        state = prefixed(
            learner=self.learner.state_dict(),
            environments=self.env.base_env.state_dict(),
            communication=self.env.transform.state_dict(),
            carried=flatten(self.collector.carried),
            episode=self.record.state_dict(),
        )
        # The transitions are by far the largest part; nothing changes them until they are written.
        big = "learner/replay/"
        return {k: v if k.startswith(big) else v.detach().clone() for k, v in state.items()}

    def load_state_dict(self, state: Mapping[str, Tensor], step: int) -> None:
        """Restores what `state_dict` gave after so many steps, into a setup that is new.

        Raises:
            ValueError, KeyError, RuntimeError: the state is not one of this configuration.
        """
        device = self.config.device
        self.learner.load_state_dict(group(state, "learner"))
        copy_into(self.env.base_env.state_dict(), group(state, "environments"))
        copy_into(self.env.transform.state_dict(), group(state, "communication"))
        carried = group(state, "carried")
        copy_into(flatten(self.collector.carried), carried)
        self.collector.restore(unflatten(carried, 1, device), step)
        self.record.load_state_dict(group(state, "episode"), device)
        self.step = step
        self.guard.start(step, self.learner.updates)
