"""What the commands do."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from emberlink.configs import known
from emberlink.envs.utils.errors import UserError
from emberlink.trainers.config.compose import override, resolve
from emberlink.trainers.config.schema import RunConfig, check_device
from emberlink.trainers.evaluation import report
from emberlink.trainers.evaluation.evaluate import Policy
from emberlink.trainers.runs.pretrained import open_run
from emberlink.trainers.runs.run_folder import RunFolder
from emberlink.trainers.runs.seal import check_trained_with
from emberlink.trainers.runs.signals import Interrupted, Interruption
from emberlink.trainers.training.non_finite import NonFiniteError
from emberlink.trainers.training.resume import resume
from emberlink.trainers.training.trainer import Progress as Moment
from emberlink.trainers.training.trainer import Trainer

_EVALUATED_WITH = ("comm.", "env.")
"""beginnings of keys that an evaluation may be given in place of the run's"""


def train(method: str | None, overrides: Sequence[str], console: Console) -> int:
    """Trains a recipe, or goes on with a run, then evaluates it.

    Ctrl-C and SIGTERM finish the step, save, and end the training.
    """
    trainer = _trainer(method, overrides, console)
    config = trainer.config
    setup = trainer.setup
    if setup.step == setup.total_steps and all(run.evaluated() for run in trainer.runs):
        trainer.close()
        console.print(
            f"{trainer.run.path} is finished, {config.episodes} episodes; nothing is left to do. "
            f"More: emberlink train resume={trainer.run.path} episodes={2 * config.episodes}",
            soft_wrap=True,
        )
        return 0
    if setup.learner.learning_starts > setup.total_steps:
        console.print(
            "note: a first batch is more than this run collects: nothing will be learnt",
            style="yellow",
        )
    interruption = Interruption(trainer.stop)
    try:
        with interruption:
            _train_with_bar(trainer, console)  # the folders stay ours for the evaluation
            interruption.at_once = True
            if interruption.received:
                raise Interrupted
            for team, (one, run) in enumerate(zip(trainer.configs, trainer.runs, strict=True)):
                actor, fires = trainer.setup.team_actor(team), config.evaluation.episodes
                if not run.evaluated():
                    _evaluate(run, one, actor, run.checkpoint(), fires, console)
    except KeyboardInterrupt:
        _say_where(trainer, console)
        return interruption.status
    except ValueError as error:
        raise UserError(f"{error}; {_newest(trainer, _with(error, config))}") from None
    finally:
        trainer.close()
    return 0


def _trainer(method: str | None, overrides: Sequence[str], console: Console) -> Trainer:
    """A new training, or that of the run folder that `resume=` names."""
    if method is not None and "=" in method:
        method, overrides = None, [method, *overrides]
    folders = [text.partition("=")[2] for text in overrides if text.startswith("resume=")]
    if not folders:
        if method is None:
            raise UserError(f"{overrides[0]!r} is no method; known: {', '.join(known('method'))}")
        trainer = Trainer(resolve(method, overrides))
        trainer.start()
    elif len(folders) > 1 or not folders[0]:
        raise UserError("resume=RUN: one run folder is needed")
    else:
        others = [text for text in overrides if not text.startswith("resume=")]
        trainer = resume(Path(folders[0]), method, others)
        setup, scale = trainer.setup, trainer.rollbacks.lr_scale
        rate = "" if scale == 1 else f", learning rates x {scale:g}"
        console.print(f"resumed at step {setup.step} of {setup.total_steps}{rate}")
    config = trainer.config
    for run in trainer.runs:
        text = f"{config.method}, setup {config.setup}, fire {config.fire.name} -> {run.path}"
        console.print(text)
    return trainer


def _say_where(trainer: Trainer, console: Console) -> None:
    for run in trainer.runs:
        networks = run.networks()
        if networks:
            console.print(
                f"stopped; what was learnt is in {networks[-1]}\n"
                f"evaluate it with: emberlink eval {run.path}",
                soft_wrap=True,
            )
    console.print(f"resume with: emberlink train resume={trainer.run.path}", soft_wrap=True)


def _newest(trainer: Trainer, more: str) -> str:
    """The newest checkpoint of a run that an error ended, and how to go on from it."""
    states, command = trainer.run.states(), f"emberlink train resume={trainer.run.path}{more}"
    if not states:
        return f"there is no checkpoint: {command} begins again, if there has been none"
    return f"the last good checkpoint is {states[-1]}, resume with: {command}"


def _with(error: ValueError, config: RunConfig) -> str:
    """What a run that an error ended is to be resumed with, so that it does not end there again."""
    return (
        " on_nan=rollback" if isinstance(error, NonFiniteError) and config.on_nan == "stop" else ""
    )


def _train_with_bar(trainer: Trainer, console: Console) -> bool:
    """`Trainer.train` with a progress bar."""
    columns = (
        TextColumn("episode {task.fields[episode]}/{task.fields[episodes]}"),
        BarColumn(),
        TextColumn("coverage {task.fields[coverage]} score {task.fields[score]}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console) as bar:
        task = bar.add_task(
            "",
            total=trainer.setup.total_steps,
            completed=trainer.setup.step,
            episode=trainer.setup.episode,
            episodes=trainer.config.episodes,
            coverage="-",
            score="-",
        )

        def show(moment: Moment) -> None:
            shown: dict[str, Any] = {"completed": moment.step, "episode": moment.episode}
            if moment.lines:
                coverage, score = (
                    sum(line[name] for line in moment.lines) / len(moment.lines)
                    for name in ("coverage", "mean_reward")
                )
                shown |= {"coverage": f"{coverage:.1f}%", "mean_reward": f"{score:.2f}"}
            bar.update(task, **shown)
            if moment.note:
                console.print(moment.note, style="yellow", soft_wrap=True)

        return trainer.train(show, hold=True)


def evaluate_folder(
    name: str,
    console: Console,
    *,
    overrides: Sequence[str] = (),
    checkpoint: Path | None = None,
    fires: int | None = None,
    device: str | None = None,
) -> int:
    """Evaluates a run's frozen policy and prints the table.

    Args:
        name: a run folder, or a trained policy that comes with emberlink.
        console: told what is being done.
        overrides: `key=value` of the environment or the communication, in place of the run's.
        checkpoint: another than the newest.
        fires: episodes; as the run has it if None.
        device: another than the run's.
    """
    run = open_run(name)
    if device is not None:
        check_device(device)
    config = run.config(**({} if device is None else {"device": device}))
    label = f"_{checkpoint.stem}" if checkpoint else ""
    checkpoint = checkpoint or run.checkpoint()
    check_trained_with(checkpoint, config)
    for text in overrides:
        if not text.startswith(_EVALUATED_WITH):
            raise UserError(
                f"{text!r}: an evaluation can be given keys of {' and '.join(_EVALUATED_WITH)} only"
            )
        config = override(config, [text])
        label += "_" + re.sub(r"[^\w.=+-]", "-", text)
    actor = report.load_actor(config, checkpoint)
    _evaluate(run, config, actor, checkpoint, fires or config.evaluation.episodes, console, label)
    return 0


def _evaluate(
    run: RunFolder,
    config: RunConfig,
    actor: Policy,
    checkpoint: Path,
    fires: int,
    console: Console,
    label: str = "",
) -> None:
    """Evaluates a frozen policy, prints the table and, last, the run folder."""
    results = report.evaluate_run(
        run,
        config,
        actor,
        checkpoint=checkpoint,
        fires=fires,
        report=lambda text: console.print(f"  {text}", style="dim"),
        label=label,
    )
    report.print_table(console, results, config)
    console.print(str(run.path), soft_wrap=True)
