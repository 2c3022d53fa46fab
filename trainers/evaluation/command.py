"""Runs `emberlink eval`: evaluates a run folder and prints a table."""

import hashlib
import re
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from emberlink.envs.utils.errors import UserError
from emberlink.trainers.config.schema import check_device
from emberlink.trainers.evaluation.policy import load_policy
from emberlink.trainers.evaluation.report import evaluate_run
from emberlink.trainers.evaluation.tables import print_results
from emberlink.trainers.runs.pretrained import open_run, read_run

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
        if "=" not in text:
            raise UserError(f"{text!r}: one run is evaluated at a time; compare takes several runs")
    if device is not None:
        check_device(device)
    policy = load_policy(read_run(name), overrides, checkpoint=checkpoint, device=device)
    run = open_run(name)  # copies a trained policy of the package once all is checked
    about = [checkpoint.stem] if checkpoint else []
    parts = [*about, *(re.sub(r"[^\w.=+-]", "-", text) for text in overrides)]
    results = evaluate_run(
        run,
        policy.config,
        policy,
        checkpoint=policy.checkpoint,
        fires=fires or policy.config.evaluation.episodes,
        report=lambda text: console.print(f"  {text}", style="dim", soft_wrap=True),
        label=_shortened("".join(f"_{part}" for part in parts)),
        about=[*overrides, *about],
    )
    print_results(console, results, policy.config)
    console.print(str(run.path), soft_wrap=True)
    return 0


def _shortened(label: str) -> str:
    """Returns a suffix of file names that a file system accepts; a hash replaces the end."""
    if len(label) <= _MAX_LABEL:
        return label
    return f"{label[: _MAX_LABEL - 9]}_{hashlib.sha256(label.encode()).hexdigest()[:8]}"
