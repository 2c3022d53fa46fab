"""What the commands do."""

import signal
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
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

from . import report
from .cli import INTERRUPTED
from .config import RunConfig, check_device, resolve
from .evaluate import Policy
from .loop import Progress as Moment
from .loop import Trainer
from .run_folder import RunFolder


def train(method: str, overrides: Sequence[str], console: Console) -> int:
    """Trains a recipe, then evaluates it. Ctrl-C saves the networks and ends the training."""
    config = resolve(method, overrides)
    trainer = Trainer(config)
    trainer.start()
    for run in trainer.runs:
        console.print(f"{method}, setup {config.setup}, fire {config.fire.name} -> {run.path}")
    if trainer.enough > trainer.steps * config.num_envs:
        console.print(
            f"note: learner.batch={config.learner.batch} is more than this run collects: "
            "nothing will be learnt",
            style="yellow",
        )
    try:
        with _stopping_between_steps(trainer):
            finished = _train_with_bar(trainer, console)
        if not finished:
            raise KeyboardInterrupt
        for team, (one, run) in enumerate(zip(trainer.configs, trainer.runs, strict=True)):
            actor, fires = trainer.team_actor(team), config.evaluation.fires
            _evaluate(run, one, actor, run.checkpoint(), fires, console)
    except KeyboardInterrupt:
        for run in trainer.runs:
            console.print(
                f"stopped; what was learnt is in {run.checkpoint()}\n"
                f"evaluate it with: emberlink eval {run.path}"
            )
        return INTERRUPTED
    return 0


@contextmanager
def _stopping_between_steps(trainer: Trainer) -> Iterator[None]:
    """Ctrl-C lets the step finish, so that what is saved is whole; a second one does not wait."""

    def stop(number: int, frame: Any) -> None:
        trainer.stop()
        signal.signal(signal.SIGINT, signal.default_int_handler)

    before = signal.signal(signal.SIGINT, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


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
            total=trainer.steps,
            episode=0,
            episodes=trainer.config.episodes,
            coverage="-",
            score="-",
        )

        def show(moment: Moment) -> None:
            shown: dict[str, Any] = {"completed": moment.step, "episode": moment.episode}
            if moment.lines:
                coverage, score = (
                    sum(line[name] for line in moment.lines) / len(moment.lines)
                    for name in ("coverage", "score")
                )
                shown |= {"coverage": f"{coverage:.1f}%", "score": f"{score:.2f}"}
            bar.update(task, **shown)

        return trainer.train(show)


def evaluate_folder(
    folder: Path,
    console: Console,
    *,
    checkpoint: Path | None = None,
    fires: int | None = None,
    device: str | None = None,
) -> int:
    """Evaluates a run folder's frozen policy and prints the table."""
    run = RunFolder(folder)
    if device is not None:
        check_device(device)
    config = run.config(**({} if device is None else {"device": device}))
    label = f"_{checkpoint.stem}" if checkpoint else ""
    checkpoint = checkpoint or run.checkpoint()
    actor = report.load_actor(config, checkpoint)
    _evaluate(run, config, actor, checkpoint, fires or config.evaluation.fires, console, label)
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
