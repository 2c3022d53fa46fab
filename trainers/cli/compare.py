"""Defines the arguments of `emberlink compare`."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from emberlink.trainers.cli.parser import command

if TYPE_CHECKING:
    from rich.console import Console


def add_compare(commands: Any) -> None:
    """Adds the command to the parser."""
    comparison = command(
        commands,
        "compare",
        _compare,
        "compare runs: methods, setups, several seeds",
        "Gathers finished runs by setup, world, training fire and method and prints interquartile "
        "means with 95 % bootstrap intervals over training seeds, and the paper's claims; writes "
        "a new folder with compare.html (tables, the paper's figures 5 to 9, timelapses), "
        "compare.json and the PNGs.",
        "emberlink compare runs/ --output comparison",
    )
    comparison.add_argument(
        "folders",
        metavar="RUN",
        nargs="+",
        type=Path,
        help="run folders, folders of run folders, or names such as pretrained:tuned",
    )
    comparison.add_argument(
        "--output", metavar="FOLDER", type=Path, help="a new folder (default: compare)"
    )


def _compare(options: argparse.Namespace, console: "Console") -> int:
    from emberlink.trainers.comparison.command import compare

    return compare(options.folders, console, options.output)
