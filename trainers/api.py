"""The Python API: trains, evaluates, loads and compares policies without printing."""

import os
import signal
import threading
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from emberlink.envs.utils.atomic_io import user_path
from emberlink.trainers.comparison.comparison import Comparison, compare_runs
from emberlink.trainers.comparison.report import free_folder, write_report
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.config.values import GROUPS
from emberlink.trainers.evaluation.evaluate import evaluate as evaluate_policy
from emberlink.trainers.evaluation.evaluate_run import evaluate_run
from emberlink.trainers.evaluation.policy import to_evaluate
from emberlink.trainers.evaluation.scores import Results
from emberlink.trainers.terminal.signals import Interruption
from emberlink.trainers.training.resume import resume as resumed
from emberlink.trainers.training.trainer import Progress, Trainer

Reference = str | os.PathLike[str]
"""a run or its folder, or a trained policy of emberlink: `pretrained:METHOD`,
`pretrained:SETUP/METHOD` or `pretrained:SETUP/METHOD/SEED`"""

_ONE_AT_A_TIME = threading.Lock()
"""held while a run is trained: TorchRL's collectors and losses set its exploration type, a variable
of the process, which two threads in turn would leave set"""


@dataclass(frozen=True)
class Run:
    """A finished training."""

    path: Path
    """the run folder"""
    config: RunConfig
    """all settings"""
    results: Results
    """fire -> policy ("learned", or a scripted one) -> measure -> one number per episode; empty if
    the run was not evaluated"""

    def __fspath__(self) -> str:
        """Returns the run folder, so that a run can be given where its path can."""
        return str(self.path)


def train(
    method: str,
    *,
    setup: str = "paper",
    world: str = "paper",
    fire: str | None = None,
    learner: str | None = None,
    progress: Callable[[Progress], None] | None = None,
    evaluate_after: bool = True,
    **settings: Any,
) -> Run:
    """Trains a method, evaluates its frozen policy, and writes a run folder.

    Ctrl-C ends it after the current step, with a checkpoint; `resume` continues. Several threads
    train one after the other; several processes train at the same time.

    Args:
        method, setup, world: names that `emberlink list` shows, or of files of your own.
        fire, learner: the same; the setup's or the world's if None.
        progress: called after each decision of the team; an exception in it ends the training.
        evaluate_after: whether to evaluate at the end, as `emberlink eval` does.
        settings: other settings, by the last part of their key (`episodes=5`, `horizon=50`) or the
            whole key (`**{"learner.gamma": 0.9}`); `output="runs"` is the folder of run folders.

    Raises:
        UserError: a name or setting is not known, a value is out of range, or a file cannot be
            written.
        NonFiniteError: a number became NaN or infinite.
    """
    names = {"setup": setup, "world": world, "fire": fire, "learner": learner}
    chosen = [f"{key}={name}" for key, name in names.items() if name is not None]
    trainer = Trainer(resolve(method, chosen, **settings))
    trainer.start()
    return _finish(trainer, progress, evaluate_after)


def resume(
    run: Reference,
    *,
    progress: Callable[[Progress], None] | None = None,
    evaluate_after: bool = True,
    **settings: Any,
) -> Run:
    """Resumes a stopped training exactly where its newest checkpoint was made.

    Args:
        run: the run, or its folder.
        progress, evaluate_after: see `train`.
        settings: settings that do not affect learning: `episodes`, `device`, `logger`,
            `checkpoint_interval`, `checkpoint_steps`, and `evaluation.*`.

    Raises:
        UserError: the run cannot be resumed, or a file cannot be written.
        NonFiniteError: a number became NaN or infinite.
    """
    return _finish(resumed(os.fspath(run), **settings), progress, evaluate_after)


def evaluate(
    policy: Any,
    method: str | None = None,
    *,
    name: str = "",
    episodes: int | None = None,
    scripted: bool = True,
    checkpoint: Reference | None = None,
    device: str | None = None,
    progress: Callable[[str, str], None] | None = None,
    **settings: Any,
) -> Results:
    """Evaluates a frozen policy on test fires.

    Args:
        policy: a run, see `load`, whose folder stays as it is; or with `method` also a
            TensorDictModule, an `nn.Module`, a function (`foreign.ForeignPolicy`), or a text
            `module:NAME`, `file.py:NAME` or `file.onnx`.
        method: the method whose observations the policy reads. With it, `settings` are the keys of
            `train` (`setup`, `world`, `fire`, `seed`, ...).
        name: with `method`: writes a run folder in `output`, which `compare` reads and calls by
            this name; later commands can open the policy if it was given as a text.
        checkpoint, device, settings: see `load`.
        episodes: number of episodes, each on another fire; if None, the run's
            `evaluation.episodes`.
        scripted: whether to evaluate the scripted policies as well.
        progress: called with the names of the fire and the policy before each evaluation.

    Returns:
        fire -> policy ("learned", or a scripted one) -> measure -> one number per episode.

    Raises:
        UserError: see `load`.
    """
    report = progress or (lambda *_: None)
    settings |= {} if episodes is None else {"evaluation.episodes": episodes}
    settings |= {} if scripted else {"evaluation.scripted": []}
    chosen = [f"{key}={settings.pop(key)}" for key in GROUPS if key in settings]
    about = {"name": name, "checkpoint": checkpoint, "device": device}
    played, run = to_evaluate(policy, method, chosen, **about, **settings)
    if run is not None:
        return evaluate_run(run, played, report=report)
    fires = played.config.evaluation.episodes
    return evaluate_policy(played.config, played.actor, fires=fires, report=report)


def compare(
    paths: Reference | Sequence[Reference],
    output: Reference | None = None,
    labels: Sequence[str] = (),
) -> Comparison:
    """Compares finished runs by setup, world, training fire and method.

    Args:
        paths: run folders, folders of run folders, or `pretrained:SETUP`.
        output: a new or empty folder for compare.html and compare.json; if None, no file is
            written.
        labels: a name for the runs of each path, instead of their method.

    Returns:
        Tables of the runs, rankings with intervals, the gain of messages and the paper's claims.

    Raises:
        UserError: there are no runs, or `output` is not empty.
    """
    folder = None if output is None else free_folder(user_path(output))
    several = [paths] if isinstance(paths, str | os.PathLike) else paths
    comparison = compare_runs([user_path(path) for path in several], labels)
    return comparison if folder is None else write_report(comparison, folder)


def _finish(
    trainer: Trainer, progress: Callable[[Progress], None] | None, evaluate_after: bool
) -> Run:
    """Trains to the end, evaluates if asked to, and returns the run."""
    stopping = Interruption(trainer.stop, (signal.SIGINT,))
    in_main_thread = threading.current_thread() is threading.main_thread()
    results: Results = {}
    try:
        with stopping if in_main_thread else nullcontext(), _ONE_AT_A_TIME:
            trainer.train(progress or (lambda _: None))
            stopping.at_once = True
            if stopping.received:
                raise KeyboardInterrupt(f"saved; resume({str(trainer.run.path)!r}) continues")
            if evaluate_after:
                results = trainer.evaluate()
    finally:
        trainer.close()
    return Run(trainer.run.path, trainer.config, results)
