"""Defines the arguments of `emberlink list` and prints the names."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from emberlink.envs.utils.config_files import entry_points, known, summary
from emberlink.envs.utils.errors import UserError, unknown
from emberlink.envs.utils.plugins import defined
from emberlink.policies import scripted
from emberlink.trainers.cli.parser import command

if TYPE_CHECKING:
    from rich.console import Console

KINDS = ("methods", "setups", "worlds", "fires", "learners", "executors", "policies")


def add_list(commands: Any) -> None:
    text = """list methods, setups, worlds, fires, learners, executors, scripted policies
    Prints the names that other commands accept and what they stand for, one per line.
    emberlink list worlds
    """
    add = command(commands, "list", _list, text)
    kinds = f"{', '.join(KINDS)} (default: all)"
    add("kinds", metavar="KIND", nargs="*", default=[], help=kinds)


def _list(options: argparse.Namespace, console: "Console") -> int:
    from emberlink.trainers.terminal.console import plain_table

    for kind in options.kinds:
        if kind not in KINDS:
            raise UserError(unknown(kind, KINDS))
    wanted = options.kinds or KINDS
    for kind in wanted:
        table = plain_table(show_header=False, title=f"{kind}:" if len(wanted) > 1 else None)
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
    own = defined(Path(scripted.__path__[0]), "Scripted")
    texts = {name: " ".join(text.split("\n\n")[0].split()) for name, (_, text) in own.items()}
    points = entry_points("emberlink.scripted")
    return sorted((texts | {p.name: f"of the package {p.module}" for p in points}).items())
