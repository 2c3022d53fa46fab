"""Runs `emberlink eval`: evaluates a run folder and prints a table."""

import hashlib
import re
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from emberlink.envs.utils.errors import UserError
from emberlink.trainers.config.compose import evaluated_with
from emberlink.trainers.config.schema import RunConfig, check_device
from emberlink.trainers.evaluation.actor import load_actor
from emberlink.trainers.evaluation.evaluate import Policy
from emberlink.trainers.evaluation.report import evaluate_run
from emberlink.trainers.evaluation.results import Results
from emberlink.trainers.evaluation.tables import print_results
from emberlink.trainers.runs.pretrained import open_run, read_run
from emberlink.trainers.runs.run_folder import RunFolder

_CHANGEABLE = ("comm.", "env.", "world=", "fire.", "evaluation.scripted=", "evaluation.headline=")
"""beginnings of the settings that can be changed in an evaluation"""
_MAX_LABEL = 150
"""characters; a name of a file can have 255"""


def evaluate_folder(
    name: str,
    console: Console,
    *,
    overrides: Sequence[str] = (),
    checkpoint: Path | None = None,
    fires: int | None = None,
    device: str | None = None,
) -> int:
    """Evaluates the frozen policy of a run, prints the table and returns 0.

    Args:
        name: a run folder, or `pretrained:METHOD`.
        console: prints the table.
        overrides: texts `key=value` that change the environment, the communication or the world.
        checkpoint: file of networks; the newest of the run if None.
        fires: number of test fires, one episode each; that of the run if None.
        device: device of the evaluation; that of the run if None.

    Raises:
        UserError: a file cannot be read or written, or an argument does not fit.
    """
    for text in overrides:
        _check_changeable(text)
    run = read_run(name)
    if device is not None:
        check_device(device)
    given, checkpoint = checkpoint, checkpoint or run.checkpoint()
    config = run.config(checkpoint, **({} if device is None else {"device": device}))
    label = f"_{given.stem}" if given else ""
    for text in overrides:
        label += "_" + re.sub(r"[^\w.=+-]", "-", text)
    config = evaluated_with(config, overrides)
    actor = load_actor(config, checkpoint)
    run = open_run(name)  # copies a trained policy of the package once all is checked
    about = [text for text in overrides if not text.startswith("world=")]  # a title names it anyway
    evaluate_and_print(
        [(run, config, actor, checkpoint)],
        console,
        label=_shortened(label),
        about=[*about, *([checkpoint.stem] if given else [])],
        fires=fires,
    )
    return 0


def _check_changeable(text: str) -> None:
    """Checks that a text is `key=value` with a key that can be changed in an evaluation."""
    if "=" not in text:
        raise UserError(f"{text!r}: one run is evaluated at a time; compare takes several runs")
    if not text.startswith(_CHANGEABLE):
        raise UserError(
            f"{text!r}: an evaluation can change the world and its fire, evaluation.scripted, "
            "evaluation.headline, and keys of comm. and env. only; "
            "--fires N chooses the number of fires"
        )


def _shortened(label: str) -> str:
    """Returns a suffix of file names that a file system accepts; a hash replaces the end."""
    if len(label) <= _MAX_LABEL:
        return label
    return f"{label[: _MAX_LABEL - 9]}_{hashlib.sha256(label.encode()).hexdigest()[:8]}"


def evaluate_and_print(
    seeds: Sequence[tuple[RunFolder, RunConfig, Policy, Path]],
    console: Console,
    *,
    label: str = "",
    about: Sequence[str] = (),
    fires: int | None = None,
) -> list[Results]:
    """Evaluates the frozen policies of several seeds and prints one table and the run folders.

    Args:
        seeds: run folder, configuration, frozen policy and checkpoint of each seed.
        console: prints the table.
        label: suffix of the file names.
        about: see `evaluate_run`.
        fires: number of test fires, one episode each; that of the runs if None.

    Returns:
        The results of each seed.
    """
    results = [
        evaluate_run(
            run,
            config,
            actor,
            checkpoint=checkpoint,
            fires=fires or config.evaluation.episodes,
            report=lambda text: console.print(f"  {text}", style="dim", soft_wrap=True),
            label=label,
            about=about,
        )
        for run, config, actor, checkpoint in seeds
    ]
    print_results(console, results, [config for _, config, *_ in seeds])
    for run, *_ in seeds:
        console.print(str(run.path), soft_wrap=True)
    return results
