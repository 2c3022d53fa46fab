"""Defines the arguments of `emberlink sweep`."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from emberlink.trainers.cli.parser import command, positive

if TYPE_CHECKING:
    from rich.console import Console


def add_sweep(commands: Any) -> None:
    """Adds the command to the parser."""
    sweep = command(
        commands,
        "sweep",
        _sweep,
        "train methods x seeds x setups",
        "Trains and evaluates every combination, several runs at a time. Finished runs in the "
        "output folder are skipped, and stopped ones are resumed, so that the same command can be "
        "repeated. `status FOLDER` prints the state of each run in an output folder.",
        "emberlink sweep consensus positional setup=paper,tuned seed=0,1,2 output=runs",
        usage="emberlink sweep [--jobs N] [--dry-run] [METHOD ...] [key=value,value ...]\n"
        "       emberlink sweep status FOLDER",
    )
    sweep.add_argument(
        "arguments",
        metavar="METHOD | key=value,value",
        nargs="+",
        help="methods (default: all); keys as for train, with one value or several; "
        "executor=local, submitit (SLURM) or ray, and its keys executor.KEY=value",
    )
    sweep.add_argument("--jobs", metavar="N", type=positive, help="the same as executor.workers=N")
    sweep.add_argument("--dry-run", action="store_true", help="only print the state of each run")


def _sweep(options: argparse.Namespace, console: "Console") -> int:
    from emberlink.trainers.sweep.command import status, sweep

    first, *others = options.arguments
    if first == "status" and len(others) == 1:
        return status(Path(others[0]), console)
    jobs = [f"executor.workers={options.jobs}"] if options.jobs else []
    return sweep([*options.arguments, *jobs], console, dry=options.dry_run)
