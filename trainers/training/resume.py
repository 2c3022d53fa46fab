"""Resumes a stopped run exactly where its newest checkpoint was made."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import shown
from emberlink.trainers.config.compose import differences, override
from emberlink.trainers.config.schema import NOT_LEARNT_WITH, RunConfig
from emberlink.trainers.runs.lock import Lock
from emberlink.trainers.runs.run_folder import RunFolder
from emberlink.trainers.training import warm_start
from emberlink.trainers.training.trainer import Trainer

MAY_CHANGE = ("episodes", *NOT_LEARNT_WITH)
"""keys that may be changed when a run is resumed, besides the keys of `evaluation`"""


def resume(path: Path | str, overrides: Sequence[str] = (), **settings: Any) -> Trainer:
    """Returns the training of a run folder, restored from its newest checkpoint.

    Metrics of later episodes and incomplete files are removed. A run without a checkpoint begins
    again. The other arguments change keys of `MAY_CHANGE`.
    """
    run = RunFolder(path)
    before = run.config()
    config = override(before, overrides, **settings)
    for key, (new, old) in differences(config, before).items():
        if key not in MAY_CHANGE and not key.startswith("evaluation."):
            given = f"{key}={shown(new)}"
            raise UserError(f"{given}: the run has {key}={shown(old)}; a resumed run keeps it")
    lock = Lock(run.path)
    try:
        return _restored(Trainer(config), run, lock, before)
    except BaseException:
        lock.release()
        raise


def _restored(trainer: Trainer, run: RunFolder, lock: Lock, before: RunConfig) -> Trainer:
    """Continues a new training in a run folder, and returns it."""
    trainer.open(run, lock)
    if run.newest.exists():
        trainer.restore()
    elif len(run.metrics()) > before.checkpoint_interval:
        raise UserError(f"{run.path}: holds no {run.newest.name}, and too many episodes for none")
    else:
        warm_start.start(trainer.setup.learner, trainer.config)
    # All checks have passed; files are changed from here on.
    run.return_to(trainer.setup.episode)
    if trainer.config != before:
        run.write_config(trainer.config)
        if trainer.saved is not None:
            trainer.save()  # the next resume reads the configuration in the checkpoint
    return trainer
