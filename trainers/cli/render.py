"""Defines the arguments of `emberlink render`."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from emberlink.trainers.cli.parser import between, command, positive

if TYPE_CHECKING:
    from rich.console import Console


def add_render(commands: Any) -> None:
    """Adds the command to the parser."""
    add = command(
        commands,
        "render",
        _render,
        "an episode as GIF and MP4, or as a page to play; several runs side by side",
        "Plays the frozen policies of one or more runs on the same held-out fire from the same "
        "start positions, and draws fire, UAVs, their roles and the links of their network. Writes "
        "a GIF and an MP4 to the first run's figures, or with --output FILE.html one page that "
        "plays the episodes in a browser. A text KEY=VALUE changes a setting of the run before it. "
        "No existing file is replaced.",
        "emberlink render pretrained:consensus pretrained:consensus env.radio.range=0 "
        "--output replay.html",
    ).add_argument
    add(
        "runs",
        metavar="RUN",
        nargs="+",
        help="a run folder, or pretrained:METHOD; after it KEY=VALUE, such as env.radio.range=0, "
        "for other settings of env and comm, or world=NAME",
    )
    add(
        "--policy",
        metavar="NAME",
        action="append",
        default=[],
        help="a scripted policy to draw, too; may be given several times",
    )
    add(
        "--fire",
        metavar="FIRE",
        help="a held-out fire: NAME, INDEX or NAME:INDEX, such as huygens:3 (default: huygens:0, "
        "or the first of the run's own fires if evaluations leave huygens out)",
    )
    add(
        "--checkpoint",
        metavar="FILE",
        type=Path,
        action="append",
        default=[],
        help="a checkpoint in place of the newest; one for each run",
    )
    add(
        "--output",
        metavar="PATH",
        type=Path,
        help="a folder, or a new file that ends in .html (a page to play), .gif, .mp4 or .png (one "
        "picture)",
    )
    step, fps, size = between(0, 1_000_000), between(1, 50), between(100, 2000)
    add("--step", metavar="STEP", type=step, help="step of a .png (default: the last)")
    add("--frames", type=positive, default=126, help="maximum number of frames (default: 126)")
    add("--fps", type=fps, default=12, help="frames per second, 1 to 50 (default: 12)")
    add("--size", type=size, help="pixels of a map's longer side, 100 to 2000")
    add("--seen", action="store_true", help="draw seen fire in grey")


def _render(options: argparse.Namespace, console: "Console") -> int:
    from emberlink.trainers.evaluation.render import render

    return render(options, console)
