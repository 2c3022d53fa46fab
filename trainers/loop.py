"""Training: collect, remember, update; measure, evaluate and save at intervals."""

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector

from emberlink.envs import metrics
from emberlink.policies.actor_critic import with_noise

from . import evaluate, tracking
from .build import build_env, build_networks
from .config import RunConfig
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
    line: dict[str, Any] = field(default_factory=dict)
    """the last finished episode's line of metrics.jsonl"""


class Trainer:
    """A run: built whole before its folder is made, so that an error leaves nothing behind.

    Args:
        config: everything that the run depends on.
    """

    def __init__(self, config: RunConfig):
        self.config = config
        tracking.check(config.logger)
        generator = torch.Generator().manual_seed(config.seed)
        self.env = build_env(
            config,
            num_envs=config.num_envs,
            fire=config.fire,
            seed=config.seed,
            device=config.device,
        )
        self.actor, critic = build_networks(config, self.env, generator)
        self.learner = Learner(self.actor, critic, config.learner)
        self.steps = config.episodes * config.env.horizon
        shared = config.memory == "shared"
        self.memory = make_memory(
            config.env.num_uavs,
            shared=shared,
            capacity=config.learner.capacity,
            batch=config.learner.batch,
            most=self.steps * config.num_envs,
            device=config.device,
            generator=torch.Generator(config.device).manual_seed(config.seed),
        )
        self.enough = rows_needed(config.env.num_uavs, shared=shared, batch=config.learner.batch)
        self.collector = self._make_collector()
        self.step = self.episode = 0
        self._stopping = False
        self._run: RunFolder | None = None

    @property
    def run(self) -> RunFolder:
        """The run folder that `start` made."""
        assert self._run is not None, "start() comes first"
        return self._run

    def start(self) -> RunFolder:
        """Makes the run folder."""
        self._run = RunFolder.create(self.config)
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
        tracker = tracking.Tracker(self.config, self.run)
        try:
            self._loop(tracker, report)
        finally:
            self.collector.shutdown()
            tracker.close()
            self.save()
        return self.step == self.steps

    def rehearse(self, steps: int) -> None:
        """Collects and learns for some steps of the environments; writes nothing."""
        for _, collected in zip(range(steps), self.collector, strict=False):
            self._learn(collected)
        self.collector.shutdown()

    def save(self) -> None:
        """Writes the networks as they are to a checkpoint."""
        self.run.save(self.step, self.weights())

    def weights(self) -> dict[str, torch.Tensor]:
        """All networks and their targets by name, detached."""
        state = self.learner.loss.state_dict()
        return {name: value.detach() for name, value in state.items() if "_params." in name}

    def _make_collector(self) -> Collector:
        explorer = with_noise(
            self.actor, self.env.full_action_spec, **asdict(self.config.exploration)
        )
        # The noise is drawn by TorchRL's module from the global generator.
        torch.manual_seed(self.config.seed)
        return Collector(
            self.env,
            explorer,
            frames_per_batch=self.config.num_envs,
            total_frames=self.steps * self.config.num_envs,
            device=self.config.device,
            trust_policy=True,
        )

    def _loop(self, tracker: tracking.Tracker, report: Callable[[Progress], None]) -> None:
        config, horizon = self.config, self.config.env.horizon
        progress = Progress(0, self.steps, 0, config.episodes)
        began, moments, losses = time.monotonic(), [], []
        for collected in self.collector:
            self.step += 1
            losses += self._learn(collected)
            moments.append(collected.get("next").select(*metrics.STEP_KEYS))
            progress.step = self.step
            if self.step % horizon == 0:
                self.episode = self.step // horizon
                progress.line = self._finish_episode(moments, losses, tracker)
                progress.episode = self.episode
                seconds = round(time.monotonic() - began, 3)
                self.run.append("timing.jsonl", {"episode": self.episode, "seconds": seconds})
                moments, losses = [], []
            report(progress)
            if self._stopping:
                return

    def _learn(self, collected: TensorDictBase) -> list[torch.Tensor]:
        """Remembers a step and makes its updates: the losses, [2, uavs] each.

        There are none before the memory holds a full batch.
        """
        self.memory.extend(to_rows(collected))
        if len(self.memory) < self.enough:
            return []
        return [
            torch.stack(self.learner.update(self.memory.sample()))
            for _ in range(self.config.learner.updates)
        ]

    def _finish_episode(
        self, moments: list[TensorDictBase], losses: list[torch.Tensor], tracker: tracking.Tracker
    ) -> dict[str, Any]:
        """Measures an episode, writes its line, evaluates and saves where it is due."""
        config = self.config
        episode: Any = torch.cat(cast(Any, moments), dim=1)
        measured = metrics.episode_metrics(episode)
        line: dict[str, Any] = {"episode": self.episode, "updates": self.learner.updates}
        line |= {name: value.mean().item() for name, value in measured.items()}
        if losses:
            actor, critic = torch.stack(losses).mean((0, 2)).tolist()
            line |= {"loss_actor": actor, "loss_critic": critic}
        if config.evaluation.interval and self.episode % config.evaluation.interval == 0:
            line |= self._evaluate()
        if self.episode % config.checkpoint_interval == 0:
            self.save()
        self.run.append("metrics.jsonl", line)
        tracker.log(line, step=self.episode)
        return line

    def _evaluate(self) -> dict[str, float]:
        """The frozen policy on held-out fires: "fire/measure" -> mean."""
        results = evaluate.evaluate(
            self.config, self.actor, fires=self.config.evaluation.interval_fires, scripted=False
        )
        return {
            f"{fire}/{name}": value
            for fire, by_policy in results.items()
            for name, value in evaluate.means(by_policy[evaluate.LEARNED]).items()
        }
