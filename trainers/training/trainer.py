"""Training: collect, remember, update; measure, evaluate and save at intervals."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule

from emberlink.envs import metrics
from emberlink.envs.scenarios import fires_of
from emberlink.policies.networks.actor_critic import team_of
from emberlink.trainers.build import build_env, build_networks
from emberlink.trainers.config.compose import to_values
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.evaluation import evaluate
from emberlink.trainers.learners.ddpg import Learner
from emberlink.trainers.learners.replay_buffer import TeamSampler, make_memory, rows_needed, to_rows
from emberlink.trainers.rollout.allocator import keep_freed_memory
from emberlink.trainers.rollout.collectors import make_collector
from emberlink.trainers.rollout.cuda_graphs import graphed
from emberlink.trainers.runs import checkpoint_file
from emberlink.trainers.runs.lock import Lock
from emberlink.trainers.runs.run_folder import RunFolder
from emberlink.trainers.runs.tracking import Trackers

from . import divergence, rollback, state

LINES = ("metrics.jsonl", "timing.jsonl")
"""the files of a run folder that have a line for each episode"""
SIBLINGS = "siblings.json"
"""names the folders of the seeds that train side by side, in order"""


@dataclass
class Progress:
    """What a watcher of the training is told after each step of the environments."""

    step: int
    steps: int
    episode: int
    episodes: int
    lines: list[dict[str, Any]] = field(default_factory=list)
    """the last finished episode's line of metrics.jsonl, of every seed"""
    note: str = ""
    """what the user is to be told: that the training went back"""


class Trainer:
    """A run, or one of each seed side by side: their networks are one stack, and nothing crosses.

    Built whole before a folder is made, so that an error leaves nothing behind. From then on the
    process keeps the memory that it frees (see `allocator`).

    Args:
        config: everything that the run depends on.
    """

    def __init__(self, config: RunConfig):
        self.config = config
        keep_freed_memory()
        seeds = config.seeds or (config.seed,)
        self.configs = [replace(config, seed=seed) for seed in seeds]
        self.teams = len(seeds)
        self.envs = self.teams * config.num_envs
        self.steps = config.episodes * config.env.horizon
        self.rate = 1.0
        """share of the configuration's learning rates that is left; see `rollback`"""
        self.tries = self.furthest = 0
        """rollbacks since a checkpoint lay beyond the step that they were for, and that step"""
        self.seconds = 0.0
        """of training before this process took it up"""
        self.best: list[float | None] = [None] * self.teams
        """the highest coverage of each seed, with which best.safetensors was written"""
        self.runs: list[RunFolder] = []
        self._locks: list[Lock] = []
        self._began = time.monotonic()
        self._stopping = self._untracked = False
        self.build()

    def build(self) -> None:
        """Makes everything that training changes, as it is before the first step."""
        config = self.config
        seeds = [one.seed for one in self.configs]
        self.env = build_env(
            config, num_envs=self.envs, fire=config.fire, seed=seeds, device=config.device
        )
        generators = [torch.Generator().manual_seed(seed) for seed in seeds]
        self.actor, critic = build_networks(config, self.env, generators)
        self.learner = Learner(self.actor, critic, config.learner)
        self.learner.slow_down(self.rate)
        divergence.listen(self.env, self.learner.watch)
        uavs, shared = config.env.num_uavs, config.replay == "shared"
        self.memory = make_memory(
            uavs,
            shared=shared,
            capacity=config.learner.buffer_size,
            batch=config.learner.batch_size,
            most=self.steps * config.num_envs,
            seeds=seeds,
            device=config.device,
        )
        self.enough = rows_needed(uavs, shared=shared, batch=config.learner.batch_size)
        self.collector = make_collector(
            config, self.env, self.actor, envs=self.envs, steps=self.steps
        )
        self._update = graphed(self._sample_and_update, config.device)
        self.step = self.episode = self.updates = 0
        self.moments: list[TensorDictBase] = []
        """of the episode that is not finished, batch size [environments, steps] each"""
        self.losses: list[torch.Tensor] = []
        """of the same"""
        self.begun = 0, 0
        """steps and updates that were behind it when it was built or restored"""
        self.saved: int | None = None
        """the step of the newest checkpoint"""

    @property
    def run(self) -> RunFolder:
        """The first seed's run folder; `start` made it."""
        assert self.runs, "start() comes first"
        return self.runs[0]

    @property
    def sampler(self) -> TeamSampler:
        """What draws from the memory."""
        sampler: Any = self.memory.sampler
        return sampler

    def start(self) -> RunFolder:
        """Makes the run folders, one for each seed, and returns the first."""
        runs = [RunFolder.create(config) for config in self.configs]
        # Whoever finds a config.yaml finds all folders, the first of which has one.
        if self.teams > 1:
            for run in runs:
                run.write(SIBLINGS, {"folders": [one.path.name for one in runs]})
        for run, config in zip(runs, self.configs, strict=True):
            run.write_config(config)
        grid, horizon = self.config.env.grid, self.config.env.horizon
        self.configs = [
            replace(one, fire=fires_of(one.fire).kept(run.path, grid, horizon))
            for one, run in zip(self.configs, runs, strict=True)
        ]
        self.config = replace(self.config, fire=self.configs[0].fire)
        self.take(runs, [Lock(run.path) for run in runs])
        return self.run

    def take(self, runs: Sequence[RunFolder], locks: Sequence[Lock]) -> None:
        """Takes run folders, one for each seed, to write to; `train` gives the locks up."""
        self.runs, self._locks = list(runs), list(locks)

    def stop(self) -> None:
        """Ends the training after the step that it is at, also from a signal handler."""
        self._stopping = True

    def train(
        self, report: Callable[[Progress], None] = lambda _: None, *, hold: bool = False
    ) -> bool:
        """Trains to the end, or until `stop`, and saves.

        Where an error ends it, or an exception of a signal's, nothing more is saved: what is there
        between two steps alone is whole.

        Args:
            report: called after each step of the environments.
            hold: keeps the run folders to write more to them, until `close`.

        Returns:
            Whether it came to the end: False after `stop`.

        Raises:
            Divergence: a number was not finite, and `on_nan` is not rollback or did not help.
            ValueError: a file cannot be written, such as to a full disk.
        """
        try:
            while True:
                try:
                    self._train(report)
                    return self.step == self.steps
                except divergence.Divergence as found:
                    note = rollback.roll_back(self, found, LINES)
                progress = self._progress()
                progress.note = note
                report(progress)
        finally:
            if hold:
                self.collector.shutdown()
            else:
                self.close()

    def close(self) -> None:
        """Ends the collector and gives the run folders up; `train` does it."""
        self.collector.shutdown()
        for lock in self._locks:
            lock.release()

    def rehearse(self, steps: int) -> None:
        """Collects and learns for some steps of the environments; writes nothing."""
        for _, collected in zip(range(steps), self.collector, strict=False):
            self._learn(collected)
        self.collector.shutdown()

    def save(self) -> None:
        """Writes a checkpoint: all that this training is, and each run's networks.

        The state first: networks are evidence that there was one.

        Raises:
            Divergence: what the next step begins with is not finite.
            ValueError: it cannot be written; the checkpoints before it are as they were.
        """
        tensors = state.tensors(self)
        if name := state.not_finite(tensors):
            raise divergence.carried(self, name, tensors[name])
        if self.step > self.furthest:
            self.tries = 0
        header = {
            "kind": "state",
            "config": to_values(self.config),
            "folders": [run.path.name for run in self.runs],
            "files": [{name: run.size(name) for name in LINES} for run in self.runs],
            "best": self.best,
            "seconds": round(self.elapsed(), 3),
            **state.counters(self),
        }
        checkpoint_file.write(self.run.state(self.step), tensors, header)
        self.save_networks()
        for run in self.runs:
            run.rotate(self.config.keep_checkpoints, states=2)
        self.saved = self.step

    def save_networks(self) -> None:
        """Writes the networks alone to a checkpoint of each run."""
        for team, (config, run) in enumerate(zip(self.configs, self.runs, strict=True)):
            run.save(self.weights(team), config, self.step)

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

    def elapsed(self) -> float:
        """Seconds of training by now."""
        return self.seconds + time.monotonic() - self._began

    def _progress(self) -> Progress:
        return Progress(self.step, self.steps, self.episode, self.config.episodes)

    def _train(self, report: Callable[[Progress], None]) -> None:
        """Trains to the end, until `stop`, or until a number is not finite."""
        # After a rollback, one that has failed is not tried again.
        configs = [replace(one, logger="none") if self._untracked else one for one in self.configs]
        trackers = Trackers(configs, self.runs, episode=self.episode)
        try:
            self._loop(trackers, report)
            if self.saved != self.step:
                self._look(wait=True)
                self.save()
        finally:
            trackers.close()
            self._untracked = self._untracked or trackers.given_up

    def _look(self, *, wait: bool) -> None:
        """Ends the training where a number is not finite; before anything of it is written."""
        if self.learner.watch.look(wait=wait):
            raise divergence.found(self)

    def _loop(self, trackers: Trackers, report: Callable[[Progress], None]) -> None:
        horizon = self.config.env.horizon
        progress = self._progress()
        self._began = time.monotonic()
        for collected in self.collector:
            self.step += 1
            self.losses += self._learn(collected)
            self._look(wait=self.step % horizon == 0 or self._is_due())
            self.moments.append(collected.get("next").select(*metrics.STEP_KEYS).clone())
            progress.step = self.step
            if self.step % horizon == 0:
                self.episode = self.step // horizon
                progress.lines = self._finish_episode(trackers)
                progress.episode = self.episode
            if self._is_due():
                self.save()
            report(progress)
            if self._stopping:
                return

    def _is_due(self) -> bool:
        """Whether a checkpoint is to be made after this step."""
        config = self.config
        by_steps = config.checkpoint_steps and self.step % config.checkpoint_steps == 0
        by_episodes = self.step % (config.checkpoint_interval * config.env.horizon) == 0
        return bool(by_steps or by_episodes)

    def _learn(self, collected: TensorDictBase) -> list[torch.Tensor]:
        """Remembers a step and makes its updates: the losses, [2, teams * uavs] each.

        There are none before the memory holds a full batch.
        """
        rows = to_rows(collected, self.teams)
        self.learner.watch.collected(rows)
        self.memory.extend(rows)
        if len(self.memory) < self.enough:
            return []
        count = self.config.learner.updates_per_step
        self.updates += count
        return [self._update().clone() for _ in range(count)]

    def _sample_and_update(self) -> torch.Tensor:
        return torch.stack(self.learner.update(self.memory.sample()))

    def _finish_episode(self, trackers: Trackers) -> list[dict[str, Any]]:
        """Measures an episode, evaluates where it is due, writes the lines."""
        config = self.config
        lines = self._measure(self.moments, self.losses)
        self.moments, self.losses = [], []
        interval = config.evaluation.interval
        if interval and self.episode % interval == 0:
            for team, line in enumerate(lines):
                line |= evaluate.validate(self.configs[team], self.team_actor(team))
        seconds = round(self.elapsed(), 3)
        for team, (line, run) in enumerate(zip(lines, self.runs, strict=True)):
            self._keep_best(team, line)
            run.append("metrics.jsonl", line)
            run.append("timing.jsonl", {"episode": self.episode, "seconds": seconds})
        trackers.log(lines, self.episode)
        return lines

    def _keep_best(self, team: int, line: dict[str, Any]) -> None:
        """Writes the networks whose coverage is the highest so far.

        On validation fires, where there are evaluations during training; else the episode's own.
        """
        frozen = [value for name, value in line.items() if name.endswith("/coverage")]
        if self.config.evaluation.interval and not frozen:
            return
        coverage = sum(frozen) / len(frozen) if frozen else line["coverage"]
        best = self.best[team]
        if best is None or coverage > best:
            self.best[team] = coverage
            self.runs[team].save_best(self.weights(team), self.configs[team], self.step)

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
