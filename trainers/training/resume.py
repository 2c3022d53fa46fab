"""Going on with a run that was stopped, as if it had not been."""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import shown
from emberlink.trainers.config.compose import override
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.runs import checkpoint_file
from emberlink.trainers.runs.lock import Lock
from emberlink.trainers.runs.run_folder import RunFolder, step_of
from emberlink.trainers.runs.safe_read import LONGEST_YAML, parse_json, read_text
from emberlink.trainers.runs.seal import MAY_CHANGE, check_same, differences

from . import state, state_header
from .trainer import LINES, SIBLINGS, Trainer


def resume(path: Path, method: str | None = None, overrides: Sequence[str] = ()) -> Trainer:
    """The training of a run folder, where its newest checkpoint was made.

    Metrics of later steps are cut off, and later or half-written checkpoints taken away: the
    training makes them again. A run that has no checkpoint yet begins again.

    Args:
        path: a run folder, of any of the seeds that train side by side; or one of its
            `checkpoints/state_*.safetensors`, to go back further.
        method: must be the run's, if given.
        overrides: `key=value`, of keys that change nothing that was learnt.

    Raises:
        ValueError: one line that says what cannot be resumed and why. Nothing was changed.
    """
    chosen = path if path.suffix == ".safetensors" else None
    runs = _runs(path.absolute().parent.parent if chosen else path)
    before = runs[0].config()
    _check_siblings(runs, before)
    config = _changed(before, method, overrides)
    with ExitStack() as stack:
        locks = [Lock(run.path) for run in runs]
        for lock in locks:
            stack.callback(lock.release)
        if chosen is None and not (runs[0].states() or runs[0].networks()):
            _check_beginning(runs, config)
        trainer = Trainer(config)
        sizes = _restore(trainer, runs, chosen)
        for run, of in zip(runs, sizes, strict=True):
            run.own_checkpoints()
            for file in LINES:
                run.check_lines(file, of[file], trainer.episode)
        # From here on everything is known to fit.
        for run, of, one in zip(runs, sizes, trainer.configs, strict=True):
            for file in LINES:
                run.cut(file, of[file])
            run.take_away_after(trainer.step)
            if config != before or not run.has_config():
                run.write_config(one)
        trainer.take(runs, locks)
        if trainer.step:
            trainer.saved = trainer.step
            trainer.save_networks()
        stack.pop_all()
    return trainer


def _runs(folder: Path) -> list[RunFolder]:
    """The folders of all seeds that train with the one whose folder this is, in order."""
    file = folder / SIBLINGS
    try:
        if not file.exists():
            return [RunFolder(folder)]
        names = parse_json(read_text(file, LONGEST_YAML))["folders"]
        runs = [RunFolder(folder.resolve().parent / Path(name).name) for name in names]
        missing = [run.path for run in runs if not run.path.is_dir()]
        if folder.resolve() not in [run.path for run in runs]:
            raise UserError(folder)
        linked = [run.path for run in runs if run.path.is_symlink()]
    except PermissionError as error:
        raise UserError(f"{file}: cannot be read: {error.strerror}") from None
    except (OSError, ValueError, TypeError, KeyError):
        raise UserError(f"{file}: does not name the folders of the other seeds") from None
    for path in linked:
        raise UserError(f"{path}: cannot be resumed: it is a link, named by {file}")
    for path in missing:
        raise UserError(f"{path}: is missing; its seed trains side by side with {folder}")
    return runs


def _check_siblings(runs: Sequence[RunFolder], config: RunConfig) -> None:
    """That each seed's folder is of this training, as far as it has got to say so."""
    seeds = config.seeds or (config.seed,)
    if len(runs) != len(seeds):
        raise UserError(
            f"{runs[0].path}: is of {len(seeds)} seeds, {SIBLINGS} names {len(runs)} folders"
        )
    for run, seed in zip(runs, seeds, strict=True):
        if not run.has_config():
            continue
        own = run.config()
        if replace(own, seed=config.seed) != config:
            raise UserError(f"{run.path / 'config.yaml'}: not of the run of {runs[0].path}")
        if own.seed != seed:
            raise UserError(f"{run.path / 'config.yaml'}: seed={own.seed}, not {seed}")


def _check_beginning(runs: Sequence[RunFolder], config: RunConfig) -> None:
    """That a run without a checkpoint never had one: its lines are few, and it begins again."""
    most = config.checkpoint_interval
    if config.checkpoint_steps:
        most = min(most, -(-config.checkpoint_steps // config.env.horizon))
    for run in runs:
        lines = run.lines()
        if len(lines) > most or (run.path / "eval.json").exists():
            raise UserError(
                f"{run.path}: has metrics of {len(lines)} episodes and no checkpoint "
                "(checkpoints/state_*.safetensors): nothing to go on from, and nothing was changed"
            )
        run.own_checkpoints()


def _changed(config: RunConfig, method: str | None, overrides: Sequence[str]) -> RunConfig:
    if method is not None and method != config.method:
        raise UserError(f"method {method!r}: the run is of method {config.method!r}")
    changed = override(config, overrides)
    for key, (new, old) in differences(changed, config).items():
        if key not in MAY_CHANGE and not key.startswith("evaluation."):
            raise UserError(f"{key}={new}: the run has {key}={old}; a resumed run keeps it")
    return changed


def _restore(
    trainer: Trainer, runs: Sequence[RunFolder], chosen: Path | None
) -> list[Mapping[str, int]]:
    """Puts the training where the checkpoint was made: bytes of each run's files by then."""
    first = runs[0]
    states = first.states()
    if chosen is None and not states:
        if first.networks():
            raise UserError(
                f"{first.path}: holds networks alone (checkpoints/state_*.safetensors is missing); "
                f"they can be evaluated: emberlink eval {first.path}"
            )
        return [dict.fromkeys(LINES, 0) for _ in runs]
    path = chosen or states[-1]
    try:
        header = _restore_from(trainer, path)
    except ValueError as error:
        older = [one for one in states if 0 <= step_of(one) < step_of(path)]
        hint = f"; the one before it: emberlink train resume={older[-1]}" if older else ""
        raise UserError(f"{error}{hint}") from None
    if header.folders != [run.path.name for run in runs] and len(runs) > 1:
        raise UserError(f"{path}: of the folders {shown(', '.join(header.folders))}")
    return [*header.files]


def _restore_from(trainer: Trainer, path: Path) -> state_header.Header:
    found, content = checkpoint_file.read(path)
    if found is None or found.get("kind") != "state":
        raise UserError(f"{path}: holds networks alone; nothing can be resumed from it")
    header = state_header.parse(path, found)
    if step_of(path) not in (-1, header.step):
        raise UserError(f"{path}: its header: step={header.step}: should be its name's")
    check_same(path, header.config, trainer.config)
    if header.step > trainer.steps:
        done = header.step / trainer.config.env.horizon
        raise UserError(f"episodes={trainer.config.episodes}: the run has done {done:g}")
    state.restore(trainer, path, found, content)
    return header
