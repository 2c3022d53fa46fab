"""Defines the arguments of `emberlink fire`: preview, make, import."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from emberlink.trainers.cli.parser import command, command_group, positive

if TYPE_CHECKING:
    from rich.console import Console

_KEYS = "keys of setup, env. and fire., as for train, such as setup=tuned, 'env.grid=[60,60]'"
_BANK = "a new file that ends in .npy, .tif or .tiff"


def add_fire(commands: Any) -> None:
    """Adds the group of commands to the parser."""
    actions = command_group(
        commands,
        "fire",
        "preview fires, write them to files, import them",
        "Draws a fire and tells whether UAVs can keep up with it, writes generated fires "
        "to files, and imports fires from files.",
        "emberlink fire preview huygens:3",
    )
    preview = command(
        actions,
        "preview",
        _preview,
        "draw a fire and tell whether UAVs can keep up",
        "Draws the arrival times of a fire with contours, prints what was understood of a file, "
        "the growth of the fire, and whether the setup's UAVs can keep up with it.",
        "emberlink fire preview ArrivalTime.asc fire.units=minutes 'env.grid=[40,40]' setup=tuned",
    )
    preview.add_argument(
        "arguments",
        metavar="SOURCE | key=value",
        nargs="+",
        help="a scenario (huygens, or huygens:3 for its test fire 3), a file (or bank.tif:3), or "
        "fire=file fire.path=FILE; " + _KEYS,
    )
    preview.add_argument("--output", metavar="PATH", type=Path, help="a folder, or a new .png file")
    make = command(
        actions,
        "make",
        _make,
        "write generated fires to a GeoTIFF or NumPy file",
        "Generates fires of a scenario and writes their arrival times, in steps, to a new file: a "
        "GeoTIFF with a band per fire, or NumPy [fires, x, y] with a .json file.",
        "emberlink fire make huygens --count 64 --split test --output fires.tif 'env.grid=[60,60]'",
    )
    make.add_argument("scenario", metavar="SCENARIO", help="a file in configs/fire")
    make.add_argument("overrides", metavar="key=value", nargs="*", help=_KEYS)
    make.add_argument("--count", metavar="N", type=positive, help="number of fires")
    make.add_argument("--split", choices=("train", "validation", "test"), default="train")
    make.add_argument("--output", metavar="FILE", type=Path, help=_BANK)
    imported = command(
        actions,
        "import",
        _import,
        "convert files of fires to a bank of fires",
        "Reads rasters, perimeters, the paper's text or banks and writes the fires on the grid of "
        "the configuration, in steps, to a new file for fire=file fire.path=BANK.",
        "emberlink fire import ArrivalTime.asc fire.units=minutes --output fires.npy",
    )
    imported.add_argument(
        "arguments",
        metavar="FILE | key=value",
        nargs="+",
        help="files with one fire or more; " + _KEYS,
    )
    imported.add_argument("--output", metavar="BANK", type=Path, required=True, help=_BANK)
    for name, parser in (("preview", preview), ("make", make), ("import", imported)):
        parser.set_defaults(command=f"fire {name}")


# Commands import their code when they run, so that `emberlink --help` does not import torch.


def _preview(options: argparse.Namespace, console: "Console") -> int:
    from emberlink.trainers.fires.commands import preview

    return preview(options.arguments, console, options.output)


def _make(options: argparse.Namespace, console: "Console") -> int:
    from emberlink.trainers.fires.commands import make

    count, split, output = options.count, options.split, options.output
    return make(
        options.scenario, options.overrides, console, count=count, split=split, output=output
    )


def _import(options: argparse.Namespace, console: "Console") -> int:
    from emberlink.trainers.fires.commands import import_files

    return import_files(options.arguments, console, options.output)
