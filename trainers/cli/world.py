"""Defines the arguments of `emberlink world check`."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from emberlink.trainers.cli.parser import MOST_FIRES, between, command, command_group

if TYPE_CHECKING:
    from rich.console import Console


def add_world(commands: Any) -> None:
    """Adds the group of commands to the parser."""
    actions = command_group(
        commands,
        "world",
        "test whether worlds are calibrated",
        "Plays scripted policies to find out whether a world is hard enough and what messages "
        "are worth in it.",
        "emberlink world check front",
    )
    check = command(
        actions,
        "check",
        _check,
        "test the conditions of the suite in worlds",
        "Plays the scripted policies of worlds on test fires and prints their measures and the "
        "conditions of the suite. The exit status is 1 if a world does not satisfy one.",
        "emberlink world check front fire.burn_time=90 --validation --fires 32",
    )
    check.add_argument(
        "arguments",
        metavar="NAME | key=value",
        nargs="*",
        help="worlds (default: all that evaluate the needed policies); keys of the world to "
        "change, such as fire.burn_time=90 or setup=tuned",
    )
    number = between(1, MOST_FIRES)
    check.add_argument(
        "--fires", metavar="N", type=number, default=100, help="number of fires (default: 100)"
    )
    check.add_argument(
        "--validation",
        action="store_true",
        help="play on validation fires, for the design of a world, in place of test fires",
    )
    check.add_argument("--json", metavar="FILE", type=Path, help="a new .json file for the numbers")
    check.set_defaults(command="world check")


def _check(options: argparse.Namespace, console: "Console") -> int:
    # Commands import their code when they run, so that `--help` does not import torch.
    from emberlink.trainers.worlds.check import check

    split = "validation" if options.validation else "test"
    return check(options.arguments, console, fires=options.fires, split=split, output=options.json)
