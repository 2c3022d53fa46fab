"""Runs the training loop: collects, learns, measures, evaluates and saves."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from torch import Tensor

from emberlink.envs import metrics
from emberlink.envs.utils.errors import UserError, naming
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.evaluation import evaluate
from emberlink.trainers.evaluation.evaluate_run import evaluate_run
from emberlink.trainers.evaluation.policy import TrainedPolicy
from emberlink.trainers.evaluation.scores import Results, learned_means, validated
from emberlink.trainers.learners.base import Losses
from emberlink.trainers.runs import checkpoint
from emberlink.trainers.runs.lock import Lock
from emberlink.trainers.runs.run_folder import BEST, RunFolder
from emberlink.trainers.tracking import Tracker
from emberlink.trainers.training import warm_start
from emberlink.trainers.training.setup import TrainingSetup


class NonFiniteError(UserError):
    """Reports that a number of a training became NaN or infinite."""


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
    line: dict[str, Any]
    """line of metrics.jsonl of the last finished episode; empty before"""


class Trainer:
    """Trains a configuration in a run folder.

    The setup is built before the folder is created, so that an error leaves no files.
    """

    run: RunFolder
    """the run folder, after `start` or `resume`"""

    def __init__(self, config: RunConfig):
        self.config = config
        self.setup = TrainingSetup(config)
        self.best: float | None = None
        """headline measure of best.safetensors"""
        self.saved: int | None = None
        """step of the newest checkpoint"""
        self.changed_versions = ""
        """packages with another version than in the resumed checkpoint"""
        self._lock: Lock | None = None
        self._stopping = False

    def start(self) -> RunFolder:
        """Creates the run folder, locks it and returns it."""
        warm_start.start(self.setup.learner, self.config)  # before there are files
        self.setup.learner.load_state_dict(self.setup.learner.state_dict())  # as a resume does
        run = RunFolder.create(self.config)
        self.open(run, Lock(run.path))
        return run

    def open(self, run: RunFolder, lock: Lock) -> None:
        """Continues in a run folder, which stays locked until `close`."""
        self.run, self._lock = run, lock
        self.config = run.with_fires(self.config)

    @cached_property
    def tracker(self) -> Tracker:
        """The tracker of the run, from the first episode or evaluation on."""
        return Tracker(self.config, self.run)

    @property
    def last_checkpoint(self) -> str:
        """Names the newest checkpoint, for messages."""
        if self.saved is None:
            return "there is no checkpoint"
        return f"the last good checkpoint is {self.run.newest}, of step {self.saved}"

    def stop(self) -> None:
        """Ends the training after the current rollout; may be called from a signal handler."""
        self._stopping = True

    def close(self) -> None:
        """Closes the tracker and unlocks the run folder."""
        if "tracker" in vars(self):
            self.tracker.close()
        if self._lock is not None:
            self._lock.release()

    def train(self, report: Callable[[Progress], None] = lambda _: None) -> bool:
        """Trains to the end, or until `stop`, and saves.

        After an exception, nothing is saved: a setup is consistent only between rollouts.

        Args:
            report: called after each rollout.

        Returns:
            True at the end of the run, False after `stop`.

        Raises:
            NonFiniteError: a number is NaN or infinite.
            UserError: a file cannot be written, such as to a full disk.
        """
        setup, line = self.setup, {}
        for rollout in setup.collector:
            before = setup.step
            self._check(setup.learn(rollout))
            if setup.step % setup.horizon == 0:
                line = self._finish_episode()
            if self._is_due(before, setup.step):
                self.save()
            episodes = self.config.episodes
            report(Progress(setup.step, setup.total_steps, setup.episode, episodes, line))
            if self._stopping:
                break
        if self.saved != setup.step:
            self.save()
        return setup.step == setup.total_steps

    def evaluate(self, report: Callable[[str, str], None] = lambda *_: None) -> Results:
        """Evaluates the frozen policy, writes eval.json and figures, and tells the tracker.

        Args:
            report: called with the names of the fire and the policy before each evaluation.
        """
        config, run = self.config, self.run
        policy = TrainedPolicy(self.setup.actor, config, run.newest)
        results = evaluate_run(run, policy, report=report)
        pictures = [p for p in sorted(run.figures().iterdir()) if p.suffix in (".png", ".gif")]
        self.tracker.log_evaluation(learned_means(results), pictures)
        return results

    def save(self) -> None:
        """Writes a checkpoint.

        Raises:
            NonFiniteError: a tensor in it is not finite.
            UserError: the file cannot be written; the earlier checkpoint is unchanged.
        """
        state = self.setup.state_dict()
        # Times of fires are infinite where nothing burns.
        checked = {k: v for k, v in state.items() if not k.startswith("environments/")}
        if name := checkpoint.first_non_finite(checked):
            raise self._non_finite(name)
        self.run.sync_metrics()
        about = checkpoint.header_of(self.config, self.setup.step, best=self.best, resumable=True)
        checkpoint.write(self.run.newest, about, state)
        self.saved = self.setup.step

    def restore(self) -> None:
        """Restores a new setup from the newest checkpoint of the run folder."""
        path = self.run.newest
        header = checkpoint.read_header(path)
        if not header.resumable:
            raise UserError(f"{path}: holds networks alone, so it cannot be resumed")
        if header.step > self.setup.total_steps:
            done = header.step / self.config.env.horizon
            raise UserError(f"episodes={self.config.episodes}: the run has done {done:g}")
        with naming(path, KeyError, RuntimeError, TypeError, IndexError):
            self.setup.load_state_dict(checkpoint.read_tensors(path), header.step)
        self.saved = header.step
        versions = checkpoint.versions()
        changed = {k: v for k, v in header.versions.items() if versions.get(k) != v}
        self.changed_versions = ", ".join(
            f"{k} {changed[k]} (now {versions.get(k)})" for k in changed
        )
        before, now = header.config["evaluation"], self.config.evaluation
        compared = ("headline", "huygens", "interval_episodes", "interval")
        if all(before.get(key) == getattr(now, key) for key in compared):
            self.best = header.best

    def _finish_episode(self) -> dict[str, Any]:
        """Measures an episode, evaluates if it is due, and writes and returns the line."""
        setup, interval = self.setup, self.config.evaluation.interval
        measures = setup.record.measures()
        line = {"episode": setup.episode, "updates": setup.learner.updates} | measures
        setup.record.clear()
        if interval and setup.episode % interval == 0:
            line |= evaluate.validate(self.config, setup.actor)
        self._keep_best(line)
        self.tracker.log(line)  # first, since a new tracker logs the lines before it
        self.run.append(line)
        return line

    def _keep_best(self, line: Mapping[str, Any]) -> None:
        """Writes best.safetensors if the headline measure is the best so far."""
        headline = self.config.evaluation.headline
        measured = validated(line, headline)
        if measured is None and self.config.evaluation.interval:
            return
        measured = line[headline] if measured is None else measured
        higher = headline in metrics.HIGHER_IS_BETTER
        if self.best is None or (measured > self.best if higher else measured < self.best):
            self.best = measured
            header = checkpoint.header_of(self.config, self.setup.step, best=measured)
            checkpoint.write(self.run.path / BEST, header, self._weights())

    def _weights(self) -> dict[str, Tensor]:
        weights = self.setup.learner.weights()
        return {f"{checkpoint.WEIGHTS}{name}": value for name, value in weights.items()}

    def _is_due(self, before: int, after: int) -> bool:
        """Returns whether a checkpoint is due between two steps."""
        config = self.config
        intervals = config.checkpoint_interval * config.env.horizon, config.checkpoint_steps
        return any(after // steps > before // steps for steps in intervals if steps)

    def _check(self, updates: Sequence[Losses]) -> None:
        """Raises NonFiniteError if a loss is not finite."""
        for losses in updates:
            for name, value in losses.items():
                if not value.isfinite().all():
                    raise self._non_finite(f"loss {name}", f"{value[~value.isfinite()][0]:g}")

    def _non_finite(self, name: str, value: str = "NaN or infinite") -> NonFiniteError:
        """Returns the error that ends the training; nothing has been saved since."""
        step = self.setup.step
        return NonFiniteError(f"{name} is {value} at step {step}; {self.last_checkpoint}")
