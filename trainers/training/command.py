"""Runs `emberlink train`: trains, shows the progress, evaluates."""

import shlex
from collections.abc import Sequence
from contextlib import suppress

from rich.console import Console

from emberlink.envs.scenarios import fires_of
from emberlink.envs.utils.errors import UserError
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.evaluation.scores import print_results, reporter
from emberlink.trainers.terminal.progress import TrainingProgress
from emberlink.trainers.terminal.signals import Interruption
from emberlink.trainers.training.resume import resume
from emberlink.trainers.training.trainer import NonFiniteError, Trainer


def train(method: str, overrides: Sequence[str], console: Console) -> int:
    """Trains a method or resumes a run, and evaluates it.

    SIGINT, SIGTERM and SIGHUP end the training after the current step with a checkpoint; the exit
    status is then 128 plus the number of the signal. `method` may be `resume=RUN`.
    """
    if method.startswith("resume="):
        trainer = resume(method.removeprefix("resume="), overrides)
    else:
        trainer = Trainer(resolve(method, overrides))
        trainer.start()
    interruption = Interruption(trainer.stop)
    try:
        _announce(trainer, console)
        with interruption:
            setup, headline = trainer.setup, trainer.config.evaluation.headline
            if setup.step < setup.total_steps:
                with TrainingProgress(console, headline, setup.total_steps, setup.step) as progress:
                    trainer.train(progress.report)
            # The run folder stays locked during the evaluation.
            interruption.at_once = True
            if interruption.received:
                raise KeyboardInterrupt
            if not setup.learner.updates:
                text = "note: nothing was learnt: a batch needs more transitions than there were"
                console.print(text, style="yellow", soft_wrap=True)
            if not trainer.run.evaluated():
                results = trainer.evaluate(reporter(console))
                print_results(console, results, trainer.config)
                console.print(str(trainer.run.path), soft_wrap=True)
    except KeyboardInterrupt:
        with suppress(OSError):  # the terminal may be gone
            console.print(f"stopped; {_resume_hint(trainer)}", soft_wrap=True)
        return interruption.status
    except NonFiniteError as error:
        raise UserError(f"{error}; train a new run with smaller learning rates") from None
    except UserError as error:
        raise UserError(f"{error}; {_resume_hint(trainer)}") from None
    finally:
        trainer.close()
    return 0


def _announce(trainer: Trainer, console: Console) -> None:
    """Prints the method, the run folder, and versions that differ from the checkpoint's."""
    config, setup, run = trainer.config, trainer.setup, trainer.run
    if setup.step:
        console.print(f"resumed at step {setup.step} of {setup.total_steps}")
    text = f"{config.method}, setup {config.setup}, fire {config.fire.name} -> {run.path}"
    console.print(text, soft_wrap=True)
    if read := fires_of(config.fire).summary(config.env.grid, config.env.horizon):
        console.print(f"read: {read}", soft_wrap=True, highlight=False, markup=False)
    if setup.step == setup.total_steps and run.evaluated():
        more = f"{_resume_command(trainer)} episodes={2 * config.episodes}"
        console.print(f"{run.path} is finished; more episodes: {more}", soft_wrap=True)
        return
    if trainer.changed_versions:
        text = f"note: the checkpoint was made with {trainer.changed_versions}"
        text += ": the numbers may not be those of a run that was never stopped"
        console.print(text, style="yellow", soft_wrap=True)


def _resume_command(trainer: Trainer) -> str:
    return f"emberlink train {shlex.quote(f'resume={trainer.run.path}')}"


def _resume_hint(trainer: Trainer) -> str:
    return f"{trainer.last_checkpoint}; resume with: {_resume_command(trainer)}"
