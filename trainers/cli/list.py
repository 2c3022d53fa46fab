"""Defines the arguments of `emberlink list` and prints the names."""

import argparse
import ast
from typing import TYPE_CHECKING, Any

from emberlink.configs import describe, entry_points, known
from emberlink.envs.utils.errors import UserError, unknown
from emberlink.policies import scripted
from emberlink.trainers.cli.parser import command

if TYPE_CHECKING:
    from rich.console import Console

KINDS = ("methods", "setups", "worlds", "fires", "learners", "executors", "policies")


def add_list(commands: Any) -> None:
    """Adds the command to the parser."""
    listing = command(
        commands,
        "list",
        _list,
        "list methods, setups, worlds, fires, learners, executors, scripted policies",
        "Prints the names that other commands accept and what they stand for, one per line.",
        "emberlink list worlds",
    )
    listing.add_argument(
        "kinds", metavar="KIND", nargs="*", default=[], help=f"{', '.join(KINDS)} (default: all)"
    )


def _list(options: argparse.Namespace, console: "Console") -> int:
    from rich.table import Table

    for kind in options.kinds:
        if kind not in KINDS:
            raise UserError(unknown(kind, KINDS))
    wanted = options.kinds or KINDS
    for kind in wanted:
        table = Table(box=None, show_header=False, padding=(0, 2, 0, 0), pad_edge=False)
        table.add_column(no_wrap=True)
        if len(wanted) > 1:
            table.title, table.title_justify, table.title_style = f"{kind}:", "left", "bold"
        for name, text in described(kind):
            table.add_row(name, text)
        console.print(table)
    return 0


def described(kind: str) -> list[tuple[str, str]]:
    """Returns the names of a kind and a sentence about each, "" where there is none.

    Nothing is imported for it: classes of policies are described by their source.
    """
    if kind != "policies":
        group = kind.removesuffix("s")
        return [(name, describe(group, name)) for name in known(group)]
    (folder,) = scripted.__path__
    rows = []
    for name in scripted.ORDER:
        with open(f"{folder}/{name}.py", encoding="utf-8") as file:
            classes = [
                node for node in ast.parse(file.read()).body if isinstance(node, ast.ClassDef)
            ]
        text = ast.get_docstring(classes[-1]) or ""
        rows.append((name, " ".join(text.split("\n\n")[0].split())))
    points = entry_points.read("emberlink.scripted")
    return [*rows, *sorted((point.name, f"of the package {point.module}") for point in points)]
