"""Defines the arguments of `emberlink list` and prints the names."""

import argparse
import ast
from pathlib import Path
from typing import TYPE_CHECKING, Any

from emberlink.envs.utils.config_files import entry_points, known, summary
from emberlink.envs.utils.errors import UserError, unknown
from emberlink.policies import scripted
from emberlink.trainers.cli.parser import command

if TYPE_CHECKING:
    from rich.console import Console

KINDS = ("methods", "setups", "worlds", "fires", "learners", "executors", "policies")


def add_list(commands: Any) -> None:
    add = command(
        commands,
        "list",
        _list,
        "list methods, setups, worlds, fires, learners, executors, scripted policies",
        "Prints the names that other commands accept and what they stand for, one per line.",
        "emberlink list worlds",
    )
    kinds = f"{', '.join(KINDS)} (default: all)"
    add("kinds", metavar="KIND", nargs="*", default=[], help=kinds)


def _list(options: argparse.Namespace, console: "Console") -> int:
    from rich.table import Table

    for kind in options.kinds:
        if kind not in KINDS:
            raise UserError(unknown(kind, KINDS))
    wanted = options.kinds or KINDS
    for kind in wanted:
        table = Table(show_header=False, title=f"{kind}:" if len(wanted) > 1 else None)
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
        return [(name, summary(group, name)) for name in known(group)]
    (folder,) = scripted.__path__
    classes = {
        node.name.lower(): ast.get_docstring(node) or ""
        for file in sorted(Path(folder).glob("*.py"))
        for node in ast.parse(file.read_text(encoding="utf-8")).body
        if isinstance(node, ast.ClassDef)
    }
    own = [(name, classes[name.replace("_", "")].split("\n\n")[0]) for name in scripted.ORDER]
    points = entry_points("emberlink.scripted")
    others = sorted((point.name, f"of the package {point.module}") for point in points)
    return [*((name, " ".join(text.split())) for name, text in own), *others]
