"""Defines the arguments of `emberlink list`."""

import argparse
from typing import TYPE_CHECKING, Any

from emberlink.trainers.cli.parser import command

if TYPE_CHECKING:
    from rich.console import Console

_GROUPS = {
    "methods": "method",
    "setups": "setup",
    "worlds": "world",
    "fires": "fire",
    "learners": "learner",
}
_KINDS = (*_GROUPS, "policies")


def add_list(commands: Any) -> None:
    """Adds the command to the parser."""
    listing = command(
        commands,
        "list",
        _list,
        "list methods, setups, worlds, fires, learners, scripted policies",
        "Prints the names that other commands accept, one per line.",
        "emberlink list methods",
    )
    listing.add_argument(
        "kinds", metavar="KIND", nargs="*", default=[], help=f"{', '.join(_KINDS)} (default: all)"
    )


def _list(options: argparse.Namespace, console: "Console") -> int:
    from emberlink.envs.utils.errors import UserError

    for kind in options.kinds:
        if kind not in _KINDS:
            raise UserError(f"{kind!r} is not known; known: {', '.join(_KINDS)}")
    kinds = options.kinds or _KINDS
    for kind in kinds:
        if len(kinds) > 1:
            console.print(f"{kind}:", style="bold")
        indent = "  " if len(kinds) > 1 else ""
        for name in _names(kind):
            console.print(f"{indent}{name}", soft_wrap=True)
    return 0


def _names(kind: str) -> list[str]:
    from emberlink.configs import known
    from emberlink.policies.scripted.registry import SCRIPTED

    return list(SCRIPTED) if kind == "policies" else known(_GROUPS[kind])
