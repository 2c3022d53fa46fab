"""Defines the arguments of `emberlink fire`: preview, import."""

from typing import Any

from emberlink.trainers.cli.parser import command, command_group, path

_KEYS = "keys of setup, env. and fire., as for train, such as setup=tuned, 'env.grid=[60,60]'"


def add_fire(commands: Any) -> None:
    """Adds the group of commands to the parser."""
    actions = command_group(
        commands,
        "fire",
        "preview fires, import them from files",
        "Draws fires, and imports fires from files.",
        "emberlink fire preview huygens:3",
    )
    preview = command(
        actions,
        "fire preview",
        "fires.commands:preview",
        "draw a fire",
        "Draws the arrival times of a fire, and prints what was understood of a file.",
        "emberlink fire preview ArrivalTime.asc fire.units=minutes 'env.grid=[40,40]' setup=tuned",
    )
    source = "a scenario (or huygens:3, its test fire 3), a file (or bank.npy:3), or fire=NAME; "
    preview("arguments", metavar="SOURCE | key=value", nargs="+", help=source + _KEYS)
    preview("--output", metavar="PATH", type=path, help="a folder, or a new .png file")
    imported = command(
        actions,
        "fire import",
        "fires.commands:import_files",
        "convert files of fires to a bank of fires",
        "Reads rasters, perimeters, the paper's text or banks and writes the fires on the grid of "
        "the configuration, in steps, to a new file for fire=file fire.path=BANK.",
        "emberlink fire import ArrivalTime.asc fire.units=minutes --output fires.npy",
    )
    imported("arguments", metavar="FILE | key=value", nargs="+", help="files of fires; " + _KEYS)
    imported("--output", metavar="BANK", type=path, required=True, help="a new file, .npy")
