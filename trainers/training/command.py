"""Runs `emberlink train`: trains, shows the progress, evaluates."""

import shlex
from collections.abc import Iterator, Sequence
from contextlib import suppress

from rich.console import Console

from emberlink.envs.scenarios import fires_of
from emberlink.envs.utils.config_files import known
from emberlink.envs.utils.errors import UserError
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.evaluation.scores import print_results
from emberlink.trainers.terminal.console import OutputError
from emberlink.trainers.terminal.progress import TrainingProgress
from emberlink.trainers.terminal.signals import Interrupted, Interruption
from emberlink.trainers.tracking import check_installed
from emberlink.trainers.training.resume import resume
from emberlink.trainers.training.trainer import NonFiniteError, Progress, Trainer


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
            # The run folder stays locked during the evaluation.
            interruption.at_once = True
            if interruption.received:
                raise Interrupted
            if not trainer.run.evaluated():
                _evaluate(trainer, console)
    except KeyboardInterrupt:
        with suppress(OutputError):  # the terminal may be gone
            _print_how_to_resume(trainer, console)
        return interruption.status
    except OutputError as error:
        raise UserError(f"{error.filename}: {error.strerror}; {_resume_hint(trainer)}") from None
    except NonFiniteError as error:
        raise UserError(f"{error}; train a new run with smaller learning rates") from None
    except UserError as error:
        raise UserError(f"{error}; {_resume_hint(trainer)}") from None
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
        check_installed(config.logger)
        trainer = Trainer(config)
        trainer.start()
        return trainer
    if len(folders) > 1 or not folders[0]:
        raise UserError("resume=RUN: expected one run folder")
    others = [text for text in overrides if not text.startswith("resume=")]
    return resume(folders[0], method, others)


def _announce(trainer: Trainer, overrides: Sequence[str], console: Console) -> None:
    """Prints the method, the run folder, and notes about the training."""
    config, setup, run = trainer.config, trainer.setup, trainer.run
    if setup.step:
        console.print(f"resumed at step {setup.step} of {setup.total_steps}")
    if trainer.changed_versions:
        console.print(
            f"note: the checkpoint was made with {trainer.changed_versions}: the numbers may not "
            "be those of a run that was never stopped",
            style="yellow",
            soft_wrap=True,
        )
    text = f"{config.method}, setup {config.setup}, fire {config.fire.name} -> {run.path}"
    console.print(text, soft_wrap=True)
    if read := fires_of(config.fire).summary(config.env.grid, config.env.horizon):
        console.print(f"read: {read}", soft_wrap=True, highlight=False, markup=False)
    if setup.step == setup.total_steps and run.evaluated():
        console.print(
            f"{run.path} is finished, {config.episodes} episodes; nothing is left to do. "
            f"More: {_resume_command(trainer)} episodes={2 * config.episodes}",
            soft_wrap=True,
        )
    else:
        for note in _notes(trainer, overrides):
            console.print(f"note: {note}", style="yellow", soft_wrap=True)


def _notes(trainer: Trainer, overrides: Sequence[str]) -> Iterator[str]:
    """Yields notes on surprising settings of a training."""
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
    if config.policy.memory == "none":
        for text in overrides:
            if text.startswith(("policy.units=", "learner.sequence=")):
                yield f"{text} has no effect without a memory (policy.memory)"


def _learns(trainer: Trainer) -> bool:
    setup = trainer.setup
    starts = setup.learner.learning_starts * trainer.config.policy.hold
    return starts <= setup.total_steps


def _train(trainer: Trainer, console: Console) -> None:
    """Trains and shows the progress; raises OutputError after a stop by a lost output."""
    setup = trainer.setup
    if setup.step == setup.total_steps:
        return
    failures: list[OutputError] = []
    progress = TrainingProgress(
        console,
        steps=setup.total_steps,
        episodes=trainer.config.episodes,
        step=setup.step,
        headline=trainer.config.evaluation.headline,
    )

    def report(state: Progress) -> None:
        if failures:
            return
        try:
            progress.step(state.step)
            if state.line and state.step % trainer.config.env.horizon == 0:
                progress.episode(state.episode, state.line)
        except OutputError as error:
            failures.append(error)
            trainer.stop()

    with progress:
        trainer.train(report)
    if failures:
        raise failures[0]


def _evaluate(trainer: Trainer, console: Console) -> None:
    """Evaluates the trained policy and prints the results."""
    results = trainer.evaluate(lambda text: console.print(f"  {text}", style="dim", soft_wrap=True))
    print_results(console, results, trainer.config)
    console.print(str(trainer.run.path), soft_wrap=True)


def _print_how_to_resume(trainer: Trainer, console: Console) -> None:
    """Prints the commands that evaluate and resume a stopped run."""
    run = trainer.run
    if trainer.saved is not None:
        console.print(
            f"stopped; the newest networks are {run.newest}\n"
            f"evaluate them with: emberlink eval {shlex.quote(str(run.path))}",
            soft_wrap=True,
        )
    console.print(f"resume with: {_resume_command(trainer)}", soft_wrap=True)


def _resume_command(trainer: Trainer) -> str:
    return f"emberlink train {shlex.quote(f'resume={trainer.run.path}')}"


def _resume_hint(trainer: Trainer) -> str:
    """Returns text about the newest checkpoint and how to resume from it, after an error."""
    command = _resume_command(trainer)
    if trainer.saved is None:
        return f"there is no checkpoint; begin again with: {command}"
    return (
        f"the last good checkpoint is {trainer.run.newest}, of step {trainer.saved}, "
        f"resume with: {command}"
    )
