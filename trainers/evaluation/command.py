"""The command `emberlink eval`: evaluates a run folder and prints the table."""

import re
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from emberlink.envs.utils.errors import UserError
from emberlink.trainers.config.compose import override
from emberlink.trainers.config.schema import RunConfig, check_device
from emberlink.trainers.evaluation.actor import load_actor
from emberlink.trainers.evaluation.evaluate import Policy
from emberlink.trainers.evaluation.report import evaluate_run
from emberlink.trainers.evaluation.results import Results
from emberlink.trainers.evaluation.tables import print_results
from emberlink.trainers.runs.pretrained import open_run
from emberlink.trainers.runs.run_folder import RunFolder
from emberlink.trainers.runs.seal import check_trained_with

_CHANGEABLE = ("comm.", "env.")
"""beginnings of the keys that an evaluation may be given in place of the run's"""


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
        name: a run folder, or a trained policy that comes with emberlink.
        console: where the table is printed.
        overrides: `key=value` of the environment or the communication, in place of the run's.
        checkpoint: a checkpoint; the newest if None.
        fires: number of episodes; the run's if None.
        device: a device; the run's if None.

    Raises:
        UserError: one line for whatever cannot be read, played or written.
    """
    run = open_run(name)
    if device is not None:
        check_device(device)
    config = run.config(**({} if device is None else {"device": device}))
    label = f"_{checkpoint.stem}" if checkpoint else ""
    checkpoint = checkpoint or run.checkpoint()
    check_trained_with(checkpoint, config)
    for text in overrides:
        if "=" not in text:
            raise UserError(f"{text!r}: one run is evaluated at a time; compare takes several runs")
        if not text.startswith(_CHANGEABLE):
            raise UserError(
                f"{text!r}: an evaluation can be given keys of {' and '.join(_CHANGEABLE)} only"
            )
        config = override(config, [text])
        label += "_" + re.sub(r"[^\w.=+-]", "-", text)
    actor = load_actor(config, checkpoint)
    evaluate_and_print([(run, config, actor, checkpoint)], console, label=label, fires=fires)
    return 0


def evaluate_and_print(
    seeds: Sequence[tuple[RunFolder, RunConfig, Policy, Path]],
    console: Console,
    *,
    label: str = "",
    fires: int | None = None,
) -> list[Results]:
    """Evaluates the frozen policies of several seeds and prints one table, then the folders.

    Args:
        seeds: run folder, configuration, frozen policy and checkpoint of each seed.
        console: where the table is printed.
        label: ends the names of the files.
        fires: number of episodes; the run's if None.

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
            report=lambda text: console.print(f"  {text}", style="dim"),
            label=label,
        )
        for run, config, actor, checkpoint in seeds
    ]
    print_results(console, results, [config for _, config, *_ in seeds])
    for run, *_ in seeds:
        console.print(str(run.path), soft_wrap=True)
    return results
