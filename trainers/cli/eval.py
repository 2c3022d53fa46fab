"""Defines the arguments of `emberlink eval`."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from emberlink.trainers.cli.parser import MOST_FIRES, between, command

if TYPE_CHECKING:
    from rich.console import Console


def add_eval(commands: Any) -> None:
    """Adds the command to the parser."""
    add = command(
        commands,
        "eval",
        _eval,
        "evaluate the frozen policies of a run",
        "Loads the newest checkpoint of a run, plays the frozen policies and the scripted ones on "
        "the same test fires, prints a table, and writes eval.json, figures, a GIF and a replay "
        "page to the run folder.",
        "emberlink eval runs/2026-01-31_12-00-00_consensus_tuned_paper_s0 --fires 64",
    ).add_argument
    add("folder", metavar="RUN", help="a run folder, or pretrained:METHOD, pretrained:SETUP/METHOD")
    add(
        "overrides",
        metavar="key=value",
        nargs="*",
        default=[],
        help="keys of comm. or env. to change, such as env.radio.loss=0.5, world=NAME, or "
        "evaluation.scripted=[] for the frozen policies alone; "
        "the names of the files contain them",
    )
    add("--checkpoint", metavar="FILE", type=Path, help="a checkpoint (default: the newest)")
    episodes = between(1, MOST_FIRES)
    add("--fires", metavar="N", type=episodes, help="number of episodes (default: the run's)")
    add("--device", help="cpu, cuda, ... (default: the run's)")


def _eval(options: argparse.Namespace, console: "Console") -> int:
    from emberlink.trainers.evaluation.evaluate_run import run_command

    return run_command(options, console)
