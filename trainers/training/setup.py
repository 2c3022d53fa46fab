"""Sets up a training: the environments, the learner and the collector of a configuration."""

from collections.abc import Mapping
from dataclasses import replace
from importlib.metadata import version
from itertools import islice
from typing import Any

from tensordict import TensorDictBase
from torch import Tensor

from emberlink.envs.utils.errors import UserError, require
from emberlink.policies.hold import held
from emberlink.trainers.build import build_env, build_learner
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.learners.base import Losses
from emberlink.trainers.learners.tensors import copy_into, flatten, group, prefixed, unflatten
from emberlink.trainers.rollout.collector import ResumableCollector
from emberlink.trainers.training import warm_start
from emberlink.trainers.training.episode import EpisodeRecord


class TrainingSetup:
    """Holds all objects that training changes, and accesses no files."""

    def __init__(self, config: RunConfig):
        if tuple(map(int, version("torchrl").split(".")[:2])) < (0, 14):
            raise UserError(f"a training needs torchrl 0.14; installed is {version('torchrl')}")
        if config.logger == "tensorboard":
            require("tensorboard", "tensorboard", "logger=tensorboard")
        self.config, self.horizon = config, config.env.horizon
        self.total_steps = config.episodes * self.horizon
        self.step = 0
        """steps of the batch of environments so far"""
        self.env = build_env(
            config,
            num_envs=config.num_envs,
            fire=config.fire,
            seed=config.seed,
            device=config.device,
            hold=config.policy.hold,
            true_map=config.learner.reads_map,
            teacher=config.learner.reads_teacher,
        )
        self.learner = build_learner(config, self.env)
        self.rollout_steps = self.learner.rollout_steps * config.policy.hold
        """steps of the batch of environments in a rollout"""
        if self.horizon % self.rollout_steps:
            wrong = f"env.horizon={self.horizon}: must be a multiple of {self.rollout_steps}"
            raise UserError(f"{wrong}, the steps of a rollout")
        self.collector = ResumableCollector(
            self.env,
            self.learner.explorer,
            decisions=self.total_steps // config.policy.hold,
            rollout=self.learner.rollout_steps,
        )
        self.record = EpisodeRecord()

    @property
    def episode(self) -> int:
        """The number of finished episodes."""
        return self.step // self.horizon

    def learn(self, rollout: TensorDictBase) -> list[Losses]:
        """Learns from a rollout, records it and returns the losses of each update."""
        self.step += self.rollout_steps
        losses = self.learner.learn(rollout)
        self.record.add(rollout, losses)
        return losses

    def dry_run(self, steps: int) -> None:
        """Collects and learns for some steps without writing files."""
        for rollout in islice(self.collector, -(-steps // self.rollout_steps)):
            self.learn(rollout)

    @property
    def actor(self) -> Any:
        """The actors without noise; they share weights with the learner."""
        return held(self.learner.actor, self.config.policy.hold, self.config.env.num_uavs)

    def state_dict(self) -> dict[str, Tensor]:
        """Returns the state of the training, "group/name" -> tensor.

        Tensors are copied, except the transitions. The state does not contain fires, which follow
        from the configuration. Random numbers of the environments are hashes of seeds and counters.
        """
        learner = self.learner.state_dict()
        state = prefixed(
            weights=group(learner, "weights"),
            learner={k: v for k, v in learner.items() if not k.startswith("weights/")},
            environments=self.env.base_env.state_dict(),
            communication=self.env.transform.state_dict(),
            carried=flatten(self.collector.carried),
            episode=self.record.state_dict(),
        )
        # The transitions are by far the largest part, and do not change before they are written.
        big = "learner/replay/"
        return {k: v if k.startswith(big) else v.detach().clone() for k, v in state.items()}

    def load_state_dict(self, state: Mapping[str, Tensor], step: int) -> None:
        """Restores the state of `state_dict` at a step, in a new setup.

        Raises:
            ValueError, KeyError, RuntimeError: the state does not fit this configuration.
        """
        device, carried = self.config.device, group(state, "carried")
        copy_into(flatten(self.collector.carried), carried)
        restored = unflatten(carried, 1, device)
        self.collector.restore(restored, step // self.config.policy.hold)  # resets the environments
        weights = prefixed(weights=group(state, "weights"))
        self.learner.load_state_dict(group(state, "learner") | weights)
        copy_into(self.env.base_env.state_dict(), group(state, "environments"))
        copy_into(self.env.transform.state_dict(), group(state, "communication"))
        self.record.load_state_dict(group(state, "episode"), device)
        self.step = step


def check_setup(config: RunConfig) -> None:
    """Checks that a configuration can be trained, in one environment, without training."""
    warm_start.start(TrainingSetup(replace(config, num_envs=1)).learner, config)
