"""Defines the arguments of `emberlink world`: check, sweep."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from emberlink.trainers.cli import completion
from emberlink.trainers.cli.parser import MOST_FIRES, between, command, command_group

if TYPE_CHECKING:
    from rich.console import Console

_KEYS = "keys of the world to change, such as fire.burn_time=90 or setup=tuned"


def add_world(commands: Any) -> None:
    """Adds the group of commands to the parser."""
    actions = command_group(
        commands,
        "world",
        "test whether worlds are calibrated, compare many worlds",
        "Plays scripted policies to find out whether a world is hard enough and what messages "
        "are worth in it.",
        "emberlink world check front",
    )
    _add_check(actions)
    _add_sweep(actions)


def _add_check(actions: Any) -> None:
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
        completer=completion.worlds_and_settings,
        nargs="*",
        help="worlds (default: all that evaluate the needed policies); " + _KEYS,
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


def _add_sweep(actions: Any) -> None:
    sweep = command(
        actions,
        "sweep",
        _sweep,
        "what messages are worth in many worlds",
        "Plays map_greedy without messages, with the radio, and with all messages in worlds with "
        "other speeds of the fire, grids, teams and radio ranges, on validation fires. Writes "
        "sweep.json, worlds.jsonl (a line per world) and sweep.png to FOLDER. The same command "
        "resumes a sweep that was stopped.",
        "emberlink world sweep my_sweep world=front --teams 3,6,12 --fires 16",
    )
    sweep.add_argument("folder", metavar="FOLDER", type=Path, help="a new folder, or one to resume")
    sweep.add_argument(
        "overrides",
        metavar="key=value",
        completer=completion.settings,
        nargs="*",
        default=[],
        help="world=NAME (default: front), and " + _KEYS,
    )
    _add_axis(
        sweep, "speeds", float, "0.5,0.75,1,1.5,2", "fire.head_ros in multiples of the world's"
    )
    _add_axis(sweep, "grids", int, "30,45,60,75", "cells along each side of the map")
    _add_axis(sweep, "teams", int, "2,4,6,8,12", "numbers of UAVs")
    _add_axis(sweep, "ranges", float, "5,10,15,20,40", "ranges of the radio, cells")
    number = between(2, MOST_FIRES)
    sweep.add_argument(
        "--fires", metavar="N", type=number, default=8, help="fires per world (default: 8)"
    )
    sweep.set_defaults(command="world sweep")


def _add_axis(
    sweep: argparse.ArgumentParser, name: str, kind: type[int | float], values: str, text: str
) -> None:
    sweep.add_argument(
        f"--{name}",
        metavar="N,N,...",
        type=_numbers(kind),
        default=_numbers(kind)(values),
        help=f"{text} (default: {values})",
    )


def _numbers(kind: type[int | float]) -> Callable[[str], list[int | float]]:
    """Returns a converter of texts such as 30,60 to different numbers above 0, in order."""

    def numbers(text: str) -> list[int | float]:
        try:
            values = [kind(part) for part in text.split(",")]
        except ValueError:
            values = []
        if not values or not all(0 < value < 1e6 for value in values):
            whole = "whole " if kind is int else ""
            raise argparse.ArgumentTypeError(
                f"{text!r} is not a list of {whole}numbers above 0, such as 1,2"
            )
        return sorted(set(values))

    return numbers


# Commands import their code when they run, so that `emberlink --help` does not import torch.


def _check(options: argparse.Namespace, console: "Console") -> int:
    from emberlink.trainers.worlds.check import check

    split = "validation" if options.validation else "test"
    return check(options.arguments, console, fires=options.fires, split=split, output=options.json)


def _sweep(options: argparse.Namespace, console: "Console") -> int:
    from emberlink.trainers.worlds.axes import Axes
    from emberlink.trainers.worlds.sweep import sweep

    axes = Axes(options.speeds, options.grids, options.teams, options.ranges)
    return sweep(options.folder, options.overrides, console, axes=axes, fires=options.fires)
