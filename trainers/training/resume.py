"""Resumes a stopped run exactly where its newest checkpoint was made."""

import shlex
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import shown
from emberlink.trainers.config.compose import override
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.runs.checkpoints import step_of
from emberlink.trainers.runs.run_folder import RunFolder
from emberlink.trainers.runs.seal import MAY_CHANGE, check_same, differences
from emberlink.trainers.training import checkpoints, warm_start
from emberlink.trainers.training.folders import RunFolders, Sizes, check_seeds, empty, find_runs
from emberlink.trainers.training.trainer import Trainer


def resume(path: Path, method: str | None = None, overrides: Sequence[str] = ()) -> Trainer:
    """Returns the training of a run folder, restored from its newest checkpoint.

    Metrics and checkpoints of later steps, and incomplete checkpoints, are removed. A run without a
    checkpoint begins again.

    Args:
        path: run folder of any seed of the training, or one of its older
            `checkpoints/state_*.safetensors`.
        method: if given, must be the method of the run.
        overrides: texts `key=value`, of keys that do not affect learning.

    Raises:
        UserError: the run cannot be resumed, and no file has changed; or a file cannot be written.
    """
    chosen = path if path.suffix == ".safetensors" else None
    runs = find_runs(path.absolute().parent.parent if chosen else path)
    if chosen is None:
        _check_state(runs[0])
    # The device of the run may not exist here, so it is replaced before it is checked.
    devices = [text.partition("=")[2] for text in overrides if text.startswith("device=")]
    before = runs[0].config(**({"device": devices[-1]} if devices else {}))
    check_seeds(runs, before)
    config = _changed(before, method, overrides)
    seeds = config.seeds or (config.seed,)
    folders = RunFolders(runs, [replace(config, seed=seed) for seed in seeds])
    try:
        if chosen is None and not runs[0].states():
            # With the intervals of the run so far; those of now may be shorter.
            _check_beginning(runs, before)
        trainer = Trainer(config)
        sizes = _restore(trainer, folders, chosen)
        folders.check_lines(sizes, trainer.setup.episode)
        # All checks have passed; files are changed from here on.
        folders.cut_back(sizes, trainer.setup.step)
        for run, run_config in zip(runs, folders.configs, strict=True):
            # An earlier resume may have ended between the files of two seeds.
            if overrides or len(runs) > 1 or not run.has_config():
                run.write_config(run_config)
        trainer.folders = folders
        if trainer.setup.step:
            _save(trainer)
    except BaseException:
        folders.close()
        raise
    return trainer


def _check_beginning(runs: Sequence[RunFolder], config: RunConfig) -> None:
    """Checks that a run without a checkpoint has too few lines to have had one.

    Raises:
        UserError: the run has more lines, or an evaluation.
    """
    most = config.checkpoint_interval
    if config.checkpoint_steps:
        most = min(most, -(-config.checkpoint_steps // config.env.horizon))
    for run in runs:
        lines = run.lines()
        if len(lines) > most or (run.path / "eval.json").exists():
            raise UserError(
                f"{run.path}: has metrics of {len(lines)} episodes and no checkpoint "
                "(checkpoints/state_*.safetensors): it cannot be resumed, and nothing was changed"
            )
        run.own_checkpoints()


def _check_state(run: RunFolder) -> None:
    """Checks that a run has not networks alone, as trained policies of the package have."""
    if run.networks() and not run.states():
        raise UserError(
            f"{run.path}: holds networks alone (checkpoints/state_*.safetensors is missing); they "
            f"can be evaluated: emberlink eval {shlex.quote(str(run.path))}"
        )


def _changed(config: RunConfig, method: str | None, overrides: Sequence[str]) -> RunConfig:
    """Returns the configuration with the overrides.

    Raises:
        UserError: an override changes a key that may not change.
    """
    if method is not None and method != config.method:
        raise UserError(f"method {method!r}: the run is of method {config.method!r}")
    changed = override(config, overrides)
    for key, (new, old) in differences(changed, config).items():
        if key not in MAY_CHANGE and not key.startswith("evaluation."):
            raise UserError(
                f"{key}={shown(new)}: the run has {key}={shown(old)}; a resumed run keeps it"
            )
    return changed


def _restore(trainer: Trainer, folders: RunFolders, chosen: Path | None) -> Sequence[Sizes]:
    """Restores the training from a checkpoint and returns the file sizes of the checkpoint."""
    runs = folders.runs
    states = runs[0].states()
    if chosen is None and not states:
        warm_start.start(trainer.setup.learner, trainer.config)
        return empty(runs)
    path = chosen or states[-1]
    with _naming_the_older(states, path):
        state, tensors = checkpoints.read(path)
    check_same(path, state.config, trainer.config)
    if state.step > trainer.setup.total_steps:
        done = state.step / trainer.config.env.horizon
        raise UserError(f"episodes={trainer.config.episodes}: the run has done {done:g}")
    with _naming_the_older(states, path):
        trainer.restore(path, state, tensors)
    if len(runs) > 1 and state.folders != folders.names:
        raise UserError(
            f"{path}: was saved for other run folders: {shown(', '.join(state.folders))}"
        )
    return state.sizes


@contextmanager
def _naming_the_older(states: Sequence[Path], path: Path) -> Iterator[None]:
    """Adds the checkpoint before `path` to the message that `path` is damaged."""
    try:
        yield
    except UserError as error:
        older = [state for state in states if 0 <= step_of(state) < step_of(path)]
        argument = shlex.quote(f"resume={older[-1]}") if older else ""
        hint = f"; the one before it: emberlink train {argument}" if older else ""
        raise UserError(f"{error}{hint}") from None


def _save(trainer: Trainer) -> None:
    """Writes what is missing of the checkpoint that was restored."""
    step = trainer.setup.step
    if trainer.run.state(step).exists():
        trainer.saved = step
        # Also removes a checkpoint too many, if the run was killed before the removal.
        trainer.save_networks()
    else:  # a state of another name was restored
        trainer.save()
