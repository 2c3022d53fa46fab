"""Runs the training loop: collects, learns, measures, evaluates and saves."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from torch import Tensor

from emberlink.envs import metrics
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.evaluation import evaluate
from emberlink.trainers.runs.run_folder import RunFolder
from emberlink.trainers.runs.seal import to_header
from emberlink.trainers.runs.versions import changed, versions
from emberlink.trainers.tracking.trackers import Trackers
from emberlink.trainers.training import checkpoints, non_finite, rollback, warm_start
from emberlink.trainers.training.folders import RunFolders, empty
from emberlink.trainers.training.rollback import Rollbacks
from emberlink.trainers.training.setup import TrainingSetup


@dataclass
class Progress:
    """The progress of a training after a rollout."""

    step: int
    """steps of the batch of environments so far"""
    steps: int
    """steps of the whole training"""
    episode: int
    """finished episodes"""
    episodes: int
    """episodes of the whole training"""
    lines: list[dict[str, Any]] = field(default_factory=list)
    """line of metrics.jsonl of the last finished episode, for each seed"""
    note: str = ""
    """message for the user about a rollback, or empty"""


class Trainer:
    """Trains all seeds of a configuration and writes their run folders.

    The setup is built before a folder is created, so that an error leaves no files.

    Args:
        config: configuration of the run.
    """

    def __init__(self, config: RunConfig):
        self.config = config
        self.setup = TrainingSetup(config)
        self.rollbacks = Rollbacks()
        self.seconds = 0.0
        """seconds of training before `train` was called"""
        self.best: list[float | None] = [None] * self.setup.teams
        """best headline measure of each seed; that of best.safetensors"""
        self.saved: int | None = None
        """step of the newest checkpoint"""
        self.changed_versions = ""
        """packages whose version is not that of the checkpoint that was resumed"""
        self.folders: RunFolders | None = None
        self._began = time.monotonic()
        self._stopping = self._untracked = False

    @property
    def runs(self) -> list[RunFolder]:
        """The run folders, one per seed; `start` creates them."""
        assert self.folders is not None, "start() comes first"
        return self.folders.runs

    @property
    def configs(self) -> list[RunConfig]:
        """The configurations of all seeds."""
        assert self.folders is not None, "start() comes first"
        return self.folders.configs

    @property
    def run(self) -> RunFolder:
        """The first seed's run folder."""
        return self.runs[0]

    def start(self) -> RunFolder:
        """Creates the run folders, one per seed, and returns the first."""
        warm_start.start(self.setup.learner, self.config)  # before there are files
        teams = range(self.setup.teams)
        self.folders = RunFolders.create([self.setup.seed_config(team) for team in teams])
        self.config = replace(self.config, fire=self.configs[0].fire)
        return self.run

    def stop(self) -> None:
        """Ends the training after the current rollout; may be called from a signal handler."""
        self._stopping = True

    def close(self) -> None:
        """Unlocks the run folders."""
        if self.folders is not None:
            self.folders.close()

    def elapsed(self) -> float:
        """Returns the seconds of training so far."""
        return self.seconds + time.monotonic() - self._began

    def train(
        self, report: Callable[[Progress], None] = lambda _: None, *, hold: bool = False
    ) -> bool:
        """Trains to the end, or until `stop`, and saves.

        After an exception, nothing is saved: a setup is consistent only between rollouts.

        Args:
            report: called after each rollout.
            hold: whether the run folders stay locked until `close`.

        Returns:
            True at the end of the run, False after `stop`.

        Raises:
            NonFiniteError: a number is NaN or infinite, and `on_nan` is "stop" or the rollbacks
                failed.
            UserError: a file cannot be written, such as to a full disk.
        """
        try:
            while True:
                try:
                    self._train(report)
                    return self.setup.step == self.setup.total_steps
                except non_finite.NonFiniteError as error:
                    if self.config.on_nan != "rollback":
                        raise
                    note = self.roll_back(error)
                report(self._progress(note=note))
        finally:
            if not hold:
                self.close()

    def _train(self, report: Callable[[Progress], None]) -> None:
        """Trains to the end, or until `stop` or a NaN or Inf."""
        # A failed tracker is not started again after a rollback.
        quiet = [replace(config, logger="none") for config in self.configs]
        configs = quiet if self._untracked else self.configs
        trackers = Trackers(configs, self.runs, episode=self.setup.episode)
        try:
            self._loop(trackers, report)
            if self.saved != self.setup.step:
                non_finite.check(self.setup, self.run, wait=True)
                self.save()
        finally:
            trackers.close()
            self._untracked = self._untracked or trackers.given_up

    def _loop(self, trackers: Trackers, report: Callable[[Progress], None]) -> None:
        setup, lines = self.setup, []
        self._began = time.monotonic()
        for rollout in setup.collector:
            before = setup.step
            setup.learn(rollout)
            ends, due = setup.step % setup.horizon == 0, self._is_due(before, setup.step)
            non_finite.check(setup, self.run, wait=ends or due)
            if ends:
                lines = self._finish_episode(trackers)
            if due:
                self.save()
            report(self._progress(lines=lines))
            if self._stopping:
                return

    def _progress(self, **more: Any) -> Progress:
        setup = self.setup
        return Progress(setup.step, setup.total_steps, setup.episode, self.config.episodes, **more)

    def _is_due(self, before: int, after: int) -> bool:
        """Returns whether a checkpoint is due between two steps."""
        config = self.config
        intervals = config.checkpoint_interval * config.env.horizon, config.checkpoint_steps
        return any(after // steps > before // steps for steps in intervals if steps)

    def _finish_episode(self, trackers: Trackers) -> list[dict[str, Any]]:
        """Measures an episode, evaluates if it is due, and writes and returns the lines."""
        setup, interval = self.setup, self.config.evaluation.interval
        counted = {"episode": setup.episode, "updates": setup.learner.updates}
        lines = [counted | measures for measures in setup.record.measures()]
        setup.record.clear()
        if interval and setup.episode % interval == 0:
            for team, line in enumerate(lines):
                with non_finite.in_validation(setup, setup.seeds[team]):
                    line |= evaluate.validate(self.configs[team], setup.team_actor(team))
        seconds = round(self.elapsed(), 3)
        for team, (line, run) in enumerate(zip(lines, self.runs, strict=True)):
            self._keep_best(team, line)
            run.append("metrics.jsonl", line)
            run.append("timing.jsonl", {"episode": setup.episode, "seconds": seconds})
        trackers.log(lines, setup.episode)
        return lines

    def _keep_best(self, team: int, line: dict[str, Any]) -> None:
        """Writes the networks of a seed if their headline measure is the best so far.

        It is measured on validation fires or, without evaluations during training, in the episode.
        """
        headline = self.config.evaluation.headline
        evaluated = [value for name, value in line.items() if name.endswith(f"/{headline}")]
        if self.config.evaluation.interval and not evaluated:
            return
        measured = sum(evaluated) / len(evaluated) if evaluated else line[headline]
        best, higher = self.best[team], headline in metrics.HIGHER_IS_BETTER
        if best is None or (measured > best if higher else measured < best):
            self.best[team] = measured
            weights = self.setup.learner.weights(team)
            self.runs[team].save_best(weights, self.configs[team], self.setup.step)

    def save(self) -> None:
        """Writes a checkpoint: the training state, then the networks of each seed.

        Raises:
            NonFiniteError: a tensor in the state is not finite.
            UserError: a file cannot be written; earlier checkpoints are unchanged.
        """
        setup, folders = self.setup, self.folders
        assert folders is not None, "start() comes first"
        tensors = setup.state_dict()
        non_finite.check_state(setup, tensors)
        self.rollbacks = self.rollbacks.passed(setup.step)
        state = checkpoints.RunState(
            step=setup.step,
            config=to_header(self.config),
            folders=folders.names,
            sizes=folders.sizes(),
            best=self.best,
            seconds=round(self.elapsed(), 3),
            rollbacks=self.rollbacks,
            tensors=len(tensors),
            versions=versions(),
        )
        checkpoints.write(self.run.state(setup.step), state, tensors)
        self.save_networks()
        self.saved = setup.step

    def save_networks(self) -> None:
        """Writes the networks of each seed, then removes older checkpoints."""
        for team, (config, run) in enumerate(zip(self.configs, self.runs, strict=True)):
            run.save(self.setup.learner.weights(team), config, self.setup.step)
        for run in self.runs:
            run.rotate(self.config.keep_checkpoints, states=2)

    def restore(self, path: Path, state: checkpoints.RunState, tensors: dict[str, Tensor]) -> None:
        """Restores a new setup from a training state.

        Raises:
            UserError: the checkpoint does not fit; the message begins with its path.
        """
        self.rollbacks = checkpoints.restore(path, self.setup, state, tensors)
        self.best, self.seconds = checkpoints.best(state, self.config), state.seconds
        self.changed_versions = changed(state.versions)

    def roll_back(self, error: non_finite.NonFiniteError) -> str:
        """Returns to the newest checkpoint, or to the beginning, with smaller learning rates.

        A checkpoint with these rates is written at once, so that a resumed run has them, too. The
        best networks are kept.

        Returns:
            A message for the user.

        Raises:
            NonFiniteError: there were too many rollbacks without progress.
            UserError: a file cannot be read or written.
        """
        assert self.folders is not None, "start() comes first"
        rollbacks, seconds, best = self.rollbacks.after(error), self.elapsed(), self.best
        self.setup, sizes = TrainingSetup(self.config), empty(self.runs)
        states = self.run.states()
        if states:
            state, tensors = checkpoints.read(states[-1])
            self.restore(states[-1], state, tensors)
            sizes = state.sizes
        else:
            warm_start.start(self.setup.learner, self.config)
        self.rollbacks, self.seconds, self.best = rollbacks, seconds, best
        self.setup.learner.scale_lr(rollbacks.lr_scale)
        self._began = time.monotonic()
        self.folders.cut_back(sizes, self.setup.step)
        line = {
            "step": error.report.step,
            "to": self.setup.step,
            "lr_scale": rollbacks.lr_scale,
            "report": str(error.report),
            "dump": error.dump.name if error.dump else None,
        }
        self.folders.append(rollback.FILE, line)
        self.save()
        return (
            f"{error}; rollback {rollbacks.count} of {rollback.MAX_ROLLBACKS}: on from step "
            f"{self.setup.step} with learning rates x {rollbacks.lr_scale:g}"
        )
