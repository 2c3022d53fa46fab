"""Defines the arguments of `emberlink list`."""

import argparse
from typing import TYPE_CHECKING, Any

from emberlink.trainers.cli.completion import KINDS, kinds
from emberlink.trainers.cli.parser import command

if TYPE_CHECKING:
    from rich.console import Console


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
        "kinds",
        metavar="KIND",
        completer=kinds,
        nargs="*",
        default=[],
        help=f"{', '.join(kinds())} (default: all)",
    )


def _list(options: argparse.Namespace, console: "Console") -> int:
    from emberlink.envs.utils.errors import UserError

    for kind in options.kinds:
        if kind not in kinds():
            raise UserError(f"{kind!r} is not known; known: {', '.join(kinds())}")
    wanted = options.kinds or kinds()
    for kind in wanted:
        if len(wanted) > 1:
            console.print(f"{kind}:", style="bold")
        _print(described(kind), "  " if len(wanted) > 1 else "", console)
    return 0


def described(kind: str) -> list[tuple[str, str]]:
    """Returns the names of a kind and a sentence about each, "" where there is none."""
    import inspect

    from emberlink.configs import describe, known

    if kind != "policies":
        return [(name, describe(KINDS[kind], name)) for name in known(KINDS[kind])]
    from emberlink.policies.scripted.registry import SCRIPTED  # imports torch

    texts = {name: inspect.getdoc(policy) or "" for name, policy in SCRIPTED.items()}
    return [(name, " ".join(text.split("\n\n")[0].split())) for name, text in texts.items()]


def _print(rows: list[tuple[str, str]], indent: str, console: "Console") -> None:
    """Prints names and descriptions in two columns; on a terminal, descriptions are wrapped."""
    import textwrap

    column = max((len(name) for name, _ in rows), default=0) + 2
    width = console.width - len(indent) - column if console.is_terminal else 10_000
    for name, text in rows:
        first, *rest = textwrap.wrap(text, max(width, 20)) or [""]
        console.print(f"{indent}{name:{column}}{first}".rstrip(), soft_wrap=True, highlight=False)
        for line in rest:
            console.print(" " * (len(indent) + column) + line, soft_wrap=True, highlight=False)
