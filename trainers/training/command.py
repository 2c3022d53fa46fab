"""Runs `emberlink train`: trains, shows the progress, evaluates."""

import shlex
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path

from rich.console import Console

from emberlink.configs import known
from emberlink.envs.utils.errors import UserError
from emberlink.policies.networks import memory
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.evaluation.command import evaluate_and_print
from emberlink.trainers.evaluation.results import learned_means
from emberlink.trainers.rollout.finite_actions import NonFiniteActionError
from emberlink.trainers.runs.run_folder import RunFolder
from emberlink.trainers.terminal import OutputError, TrainingProgress
from emberlink.trainers.terminal.signals import Interrupted, Interruption
from emberlink.trainers.tracking import loggers
from emberlink.trainers.tracking.trackers import Trackers
from emberlink.trainers.training.non_finite import NonFiniteError
from emberlink.trainers.training.resume import resume
from emberlink.trainers.training.trainer import Progress, Trainer


def train(method: str | None, overrides: Sequence[str], console: Console) -> int:
    """Trains a method or resumes a run, and evaluates it.

    SIGINT, SIGTERM, SIGHUP and a failure of the output end the training after the current step with
    a checkpoint.

    Args:
        method: name of the method, or `resume=RUN`.
        overrides: texts `key=value`.
        console: prints progress and results.

    Returns:
        The exit status: 0, or 128 plus the number of the signal that ended the training.

    Raises:
        UserError: an argument is wrong, the run cannot be resumed, or a file cannot be written.
    """
    trainer = _trainer(method, overrides)
    interruption = Interruption(trainer.stop)
    try:
        _announce(trainer, overrides, console)
        with interruption:
            _train(trainer, console)
            # The run folders are locked during the evaluation, too.
            interruption.at_once = True
            if interruption.received:
                raise Interrupted
            _evaluate(trainer, console)
    except KeyboardInterrupt:
        with suppress(OutputError):  # the terminal may be gone
            _print_how_to_resume(trainer, console)
        return interruption.status
    except OutputError as error:
        raise UserError(f"{error.filename}: {error.strerror}; {_resume_hint(trainer)}") from None
    except (UserError, NonFiniteError) as error:
        raise UserError(f"{error}; {_resume_hint(trainer, error)}") from None
    finally:
        trainer.close()
    return 0


def _trainer(method: str | None, overrides: Sequence[str]) -> Trainer:
    """Returns a new training, or the resumed training of `resume=RUN`."""
    if method is not None and "=" in method:
        method, overrides = None, [method, *overrides]
    folders = [text.partition("=")[2] for text in overrides if text.startswith("resume=")]
    if not folders:
        if method is None:
            raise UserError(
                f"{overrides[0]!r} is not a method; known: {', '.join(known('method'))}"
            )
        config = resolve(method, overrides)
        loggers.check_installed(config)
        trainer = Trainer(config)
        trainer.start()
        return trainer
    if len(folders) > 1 or not folders[0]:
        raise UserError("resume=RUN: expected one run folder")
    others = [text for text in overrides if not text.startswith("resume=")]
    return resume(Path(folders[0]), method, others)


def _announce(trainer: Trainer, overrides: Sequence[str], console: Console) -> None:
    """Prints the method, the run folders, and notes about the training."""
    config = trainer.config
    setup, scale = trainer.setup, trainer.rollbacks.lr_scale
    if setup.step:
        rate = "" if scale == 1 else f", learning rates x {scale:g}"
        console.print(f"resumed at step {setup.step} of {setup.total_steps}{rate}")
    if trainer.changed_versions:
        console.print(
            f"note: the checkpoint was made with {trainer.changed_versions}: the numbers may not "
            "be those of a run that was never stopped",
            style="yellow",
            soft_wrap=True,
        )
    for run in trainer.runs:
        text = f"{config.method}, setup {config.setup}, fire {config.fire.name} -> {run.path}"
        console.print(text, soft_wrap=True)
    if _is_finished(trainer):
        console.print(
            f"{trainer.run.path} is finished, {config.episodes} episodes; nothing is left to do. "
            f"More: {_resume_command(trainer)} episodes={2 * config.episodes}",
            soft_wrap=True,
        )
        if any(text.startswith("evaluation.") for text in overrides):
            console.print(
                "note: eval.json is that of the earlier settings of evaluations; for another one: "
                f"emberlink eval {shlex.quote(str(trainer.run.path))}",
                soft_wrap=True,
            )
    else:
        for note in _notes(trainer, overrides):
            console.print(f"note: {note}", style="yellow", soft_wrap=True)


def _notes(trainer: Trainer, overrides: Sequence[str]) -> Iterator[str]:
    """Yields what a user might not expect of a training."""
    config = trainer.config
    learner, world = config.learner, config.env
    if not _learns(trainer):
        yield (
            "a first batch needs more transitions than this run collects: nothing will be learnt"
        )
    if config.replay == "shared" and config.comm["name"] == "no_comm" and not learner.replays:
        yield (
            f"learner={learner.name} has no replay buffer to share: {config.method} trains as "
            "independent does"
        )
    squashes = config.policy.memory != "none" or not learner.replays
    if squashes and world.observation_scale == "raw" and world.observation != "sight":
        yield (
            "env.observation_scale=raw: the first layer of these networks has a tanh, which "
            "saturates with numbers of cells and steps; env.observation_scale=box scales them"
        )
    chosen = config.policy.memory
    kind = memory.find(chosen)
    filled = min(kind.burn_in(config.policy), world.horizon // config.policy.hold - 1)
    burn_in: int = getattr(learner, "burn_in", filled)
    if burn_in < filled:
        yield (
            f"learner.burn_in={burn_in}: in the middle of an episode, sequences begin with "
            f"zeros in the memory; learner.burn_in={filled} fills it"
        )
    unread = set(memory.Memory.settings).difference(kind.settings)
    for text in overrides:
        if text.partition("=")[0] in unread:
            yield f"{text} has no effect with policy.memory={chosen}"


def _is_finished(trainer: Trainer) -> bool:
    setup = trainer.setup
    return setup.step == setup.total_steps and all(run.evaluated() for run in trainer.runs)


def _learns(trainer: Trainer) -> bool:
    setup = trainer.setup
    starts = setup.learner.learning_starts * trainer.config.policy.hold
    return starts <= setup.total_steps


def _train(trainer: Trainer, console: Console) -> None:
    """Trains and shows the progress.

    Raises:
        OutputError: the output cannot be written; the training has stopped and saved.
    """
    setup = trainer.setup
    if setup.step == setup.total_steps:
        return
    failures: list[OutputError] = []
    progress = TrainingProgress(
        console,
        steps=setup.total_steps,
        episodes=trainer.config.episodes,
        step=setup.step,
        learns=_learns(trainer),
        headline=trainer.config.evaluation.headline,
    )

    def report(state: Progress) -> None:
        if failures:
            return
        try:
            _show(progress, state, trainer)
        except OutputError as error:
            failures.append(error)
            trainer.stop()

    with progress:
        trainer.train(report, hold=True)
    if failures:
        raise failures[0]


def _show(progress: TrainingProgress, state: Progress, trainer: Trainer) -> None:
    if state.note:
        progress.note(state.note, "yellow")
    progress.step(state.step, state.episode, trainer.setup.learner.updates)
    if state.lines and state.step % trainer.config.env.horizon == 0:
        progress.episode(state.episode, state.lines)


def _evaluate(trainer: Trainer, console: Console) -> None:
    """Evaluates the seeds without an evaluation, and prints and logs the results."""
    seeds = [
        (run, config, trainer.setup.team_actor(team), run.checkpoint())
        for team, (config, run) in enumerate(zip(trainer.configs, trainer.runs, strict=True))
        if not run.evaluated()
    ]
    if not seeds:
        return
    results = evaluate_and_print(seeds, console)
    runs = [run for run, *_ in seeds]
    trackers = Trackers([config for _, config, *_ in seeds], runs, episode=trainer.config.episodes)
    trackers.log_evaluation(
        [learned_means(result) for result in results],
        [_figures(run) for run in runs],
    )
    trackers.close()


def _figures(run: RunFolder) -> list[Path]:
    files = sorted((run.path / "figures").glob("*.png"))
    return [file for file in files if file.is_file() and not file.is_symlink()]


def _print_how_to_resume(trainer: Trainer, console: Console) -> None:
    """Prints the commands that evaluate and resume a stopped run."""
    for run in trainer.runs:
        networks = run.networks()
        if networks:
            console.print(
                f"stopped; the newest networks are {networks[-1]}\n"
                f"evaluate them with: emberlink eval {shlex.quote(str(run.path))}",
                soft_wrap=True,
            )
    console.print(f"resume with: {_resume_command(trainer)}", soft_wrap=True)


def _resume_command(trainer: Trainer) -> str:
    return f"emberlink train {shlex.quote(f'resume={trainer.run.path}')}"


def _resume_hint(trainer: Trainer, error: Exception | None = None) -> str:
    """Returns text about the newest checkpoint and how to resume from it, after an error."""
    config: RunConfig = trainer.config
    # Without a rollback, the run would end at the same step again.
    diverged = isinstance(error, NonFiniteError)
    command = _resume_command(trainer) + (" on_nan=rollback" if diverged else "")
    states = trainer.run.states()
    if isinstance(error, NonFiniteActionError):  # in the last evaluation
        return "the training has diverged: train a new run with smaller learning rates"
    if diverged and config.on_nan == "rollback":
        last = f"the last checkpoint is {states[-1]}; " if states else ""
        return f"{last}to resume would repeat this: train a new run with smaller learning rates"
    if not states:
        return f"there is no checkpoint; begin again with: {command}"
    return f"the last good checkpoint is {states[-1]}, resume with: {command}"
