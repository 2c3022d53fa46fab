"""Training: collect, remember, update; measure, evaluate and save at intervals."""

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.collectors import Collector

from emberlink.envs import metrics
from emberlink.policies.actor_critic import team_of
from emberlink.policies.noise import OrnsteinUhlenbeck

from . import evaluate, tracking
from .allocator import keep_freed_memory
from .build import build_env, build_networks
from .config import RunConfig
from .graphs import LockstepCollector, graphed
from .learner import Learner
from .memory import make_memory, rows_needed, to_rows
from .run_folder import RunFolder


@dataclass
class Progress:
    """What a watcher of the training is told after each step of the environments."""

    step: int
    steps: int
    episode: int
    episodes: int
    lines: list[dict[str, Any]] = field(default_factory=list)
    """the last finished episode's line of metrics.jsonl, of every seed"""


class Trainer:
    """A run, or one of each seed side by side: their networks are one stack, and nothing crosses.

    Built whole before a folder is made, so that an error leaves nothing behind. From then on the
    process keeps the memory that it frees (see `allocator`).

    Args:
        config: everything that the run depends on.
    """

    def __init__(self, config: RunConfig):
        self.config = config
        tracking.check(config.logger)
        keep_freed_memory()
        seeds = config.seeds or (config.seed,)
        self.configs = [replace(config, seed=seed) for seed in seeds]
        self.teams = len(seeds)
        self.envs = self.teams * config.num_envs
        self.env = build_env(
            config, num_envs=self.envs, fire=config.fire, seed=seeds, device=config.device
        )
        generators = [torch.Generator().manual_seed(seed) for seed in seeds]
        self.actor, critic = build_networks(config, self.env, generators)
        self.learner = Learner(self.actor, critic, config.learner)
        self.steps = config.episodes * config.env.horizon
        uavs, shared = config.env.num_uavs, config.memory == "shared"
        self.memory = make_memory(
            uavs,
            shared=shared,
            capacity=config.learner.capacity,
            batch=config.learner.batch,
            most=self.steps * config.num_envs,
            seeds=seeds,
            device=config.device,
        )
        self.enough = rows_needed(uavs, shared=shared, batch=config.learner.batch)
        self.collector = self._make_collector()
        self._update = graphed(self._sample_and_update, config.device)
        self.step = self.episode = self.updates = 0
        self.runs: list[RunFolder] = []
        self._stopping = False

    @property
    def run(self) -> RunFolder:
        """The first seed's run folder; `start` made it."""
        assert self.runs, "start() comes first"
        return self.runs[0]

    def start(self) -> RunFolder:
        """Makes the run folders, one for each seed, and returns the first."""
        self.runs = [RunFolder.create(config) for config in self.configs]
        return self.run

    def stop(self) -> None:
        """Ends the training after the step that it is at, also from a signal handler."""
        self._stopping = True

    def train(self, report: Callable[[Progress], None] = lambda _: None) -> bool:
        """Trains to the end; whatever stops it, the networks are saved as they are.

        Args:
            report: called after each step of the environments.

        Returns:
            Whether it came to the end: False after `stop`.
        """
        trackers: list[tracking.Tracker] = []
        try:
            for config, run in zip(self.configs, self.runs, strict=True):
                trackers.append(tracking.Tracker(config, run))
            self._loop(trackers, report)
        finally:
            self.save()
            self.collector.shutdown()
            for tracker in trackers:
                tracker.close()
        return self.step == self.steps

    def rehearse(self, steps: int) -> None:
        """Collects and learns for some steps of the environments; writes nothing."""
        for _, collected in zip(range(steps), self.collector, strict=False):
            self._learn(collected)
        self.collector.shutdown()

    def save(self) -> None:
        """Writes the networks as they are to a checkpoint of each run."""
        for team, run in enumerate(self.runs):
            run.save(self.step, self.weights(team))

    def weights(self, team: int = 0) -> dict[str, torch.Tensor]:
        """All networks of one seed and their targets by name, detached."""
        state = self.learner.loss.state_dict()
        return {
            name: value.detach().unflatten(0, (self.teams, -1))[team]
            for name, value in state.items()
            if "_params." in name
        }

    def team_actor(self, team: int) -> TensorDictModule:
        """The actors of one seed, without noise, as they are now."""
        return team_of(self.actor, team, self.teams)

    def _make_collector(self) -> Collector | LockstepCollector:
        parts: list[Any] = [self.actor, OrnsteinUhlenbeck(**asdict(self.config.exploration))]
        explorer = TensorDictSequential(*parts)
        if torch.device(self.config.device).type == "cuda":
            return LockstepCollector(
                self.env, explorer, horizon=self.config.env.horizon, steps=self.steps
            )
        return Collector(
            self.env,
            explorer,
            frames_per_batch=self.envs,
            total_frames=self.steps * self.envs,
            device=self.config.device,
            trust_policy=True,
            track_traj_ids=False,
            auto_register_policy_transforms=False,
        )

    def _loop(self, trackers: list[tracking.Tracker], report: Callable[[Progress], None]) -> None:
        config, horizon = self.config, self.config.env.horizon
        progress = Progress(0, self.steps, 0, config.episodes)
        began, moments, losses = time.monotonic(), [], []
        for collected in self.collector:
            self.step += 1
            losses += self._learn(collected)
            moments.append(collected.get("next").select(*metrics.STEP_KEYS).clone())
            progress.step = self.step
            if self.step % horizon == 0:
                self.episode = self.step // horizon
                progress.lines = self._finish_episode(moments, losses, trackers)
                progress.episode = self.episode
                seconds = round(time.monotonic() - began, 3)
                for run in self.runs:
                    run.append("timing.jsonl", {"episode": self.episode, "seconds": seconds})
                moments, losses = [], []
            report(progress)
            if self._stopping:
                return

    def _learn(self, collected: TensorDictBase) -> list[torch.Tensor]:
        """Remembers a step and makes its updates: the losses, [2, teams * uavs] each.

        There are none before the memory holds a full batch.
        """
        self.memory.extend(to_rows(collected, self.teams))
        if len(self.memory) < self.enough:
            return []
        count = self.config.learner.updates
        self.updates += count
        return [self._update().clone() for _ in range(count)]

    def _sample_and_update(self) -> torch.Tensor:
        return torch.stack(self.learner.update(self.memory.sample()))

    def _finish_episode(
        self,
        moments: list[TensorDictBase],
        losses: list[torch.Tensor],
        trackers: list[tracking.Tracker],
    ) -> list[dict[str, Any]]:
        """Measures an episode, writes its lines, evaluates and saves where it is due."""
        config = self.config
        lines = self._measure(moments, losses)
        if config.evaluation.interval and self.episode % config.evaluation.interval == 0:
            for team, line in enumerate(lines):
                line |= self._evaluate(team)
        if self.episode % config.checkpoint_interval == 0:
            self.save()
        for line, run, tracker in zip(lines, self.runs, trackers, strict=True):
            run.append("metrics.jsonl", line)
            tracker.log(line, step=self.episode)
        return lines

    def _measure(
        self, moments: list[TensorDictBase], losses: list[torch.Tensor]
    ) -> list[dict[str, Any]]:
        """An episode's measures and mean losses, of every seed."""
        episode: Any = torch.cat(cast(Any, moments), dim=1)
        table = {
            name: value.unflatten(0, (self.teams, -1)).mean(1)
            for name, value in metrics.episode_metrics(episode).items()
        }
        if losses:
            of_uavs = torch.stack(losses).mean(0).unflatten(1, (self.teams, -1))
            table["loss_actor"], table["loss_critic"] = of_uavs.mean(2)
        values = {name: column.tolist() for name, column in table.items()}
        counted = {"episode": self.episode, "updates": self.updates}
        return [
            counted | {name: column[team] for name, column in values.items()}
            for team in range(self.teams)
        ]

    def _evaluate(self, team: int) -> dict[str, float]:
        """A seed's frozen policy on held-out fires: "fire/measure" -> mean."""
        config = self.configs[team]
        results = evaluate.evaluate(
            config, self.team_actor(team), fires=config.evaluation.interval_fires, scripted=False
        )
        return {
            f"{fire}/{name}": value
            for fire, by_policy in results.items()
            for name, value in evaluate.means(by_policy[evaluate.LEARNED]).items()
        }
