"""Defines the arguments of `emberlink compare`."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from emberlink.trainers.cli.parser import command

if TYPE_CHECKING:
    from rich.console import Console

EXTRAS = {
    "csv": "compare.csv, one row per run, fire and measure",
    "latex": "compare.tex, the rankings by the world's headline measure",
    "marl-eval": "marl_eval.json, training and held-out fires in the format of MARL-eval",
    "replay": "a page that plays the methods side by side, for each section and fire",
    "png": "the figures as PNG",
    "pdf": "the figures as PDF",
    "svg": "the figures as SVG",
}
"""what can be written beside the page -> its help"""


def add_compare(commands: Any) -> None:
    """Adds the command to the parser."""
    comparison = command(
        commands,
        "compare",
        _compare,
        "compare runs: methods, setups, several seeds",
        "Gathers finished runs by setup, world, training fire and method and prints interquartile "
        "means with 95 % bootstrap intervals over seeds, the gain of messages, and the paper's "
        "claims; writes a new folder with compare.html, one page with all tables and figures, and "
        "compare.json.",
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
    comparison.add_argument(
        "--label",
        metavar="NAME",
        action="append",
        default=[],
        help="name of the runs of the first RUN, of the second, and so on (default: their method)",
    )
    for name, what in EXTRAS.items():
        comparison.add_argument(
            f"--{name}",
            action="append_const",
            const=name,
            dest="extras",
            default=[],
            help=f"also write {what}",
        )


def _compare(options: argparse.Namespace, console: "Console") -> int:
    from rich.text import Text

    from emberlink.trainers.comparison.comparison import compare_runs
    from emberlink.trainers.comparison.report import free_folder, printed, tables, write_report

    def say(text: str, style: str = "yellow") -> None:
        console.print(Text(text, style=style), soft_wrap=True)

    folder = free_folder(options.output)
    comparison = compare_runs(options.folders, options.label)
    for path, why in comparison.left_out:
        say(f"note: {path} is left out: {why}")
    write_report(comparison, folder, lambda text: say(f"  {text}", "dim"), options.extras)
    for note in comparison.notes:
        say(f"note: {note}")
    for section in comparison.sections:
        for table in tables(comparison, section):
            console.print(printed(table, section))
    say(str(folder / "compare.html"), "")
    return 0
