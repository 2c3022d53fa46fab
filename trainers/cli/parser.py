"""What the parsers of the command line share."""

import argparse
import sys
from collections.abc import Callable
from typing import Any, NoReturn


class Parser(argparse.ArgumentParser):
    """Says what is wrong in one line, where argparse would print the usage before it.

    A command's options may stand before, among or behind its other arguments.
    """

    _within = False

    def parse_known_args(self, args=None, namespace=None):  # pyright: ignore
        if self._within or self._subparsers is not None:
            return super().parse_known_args(args, namespace)
        self._within = True  # the other parser calls this one
        try:
            return self.parse_known_intermixed_args(args, namespace)
        finally:
            self._within = False

    def error(self, message: str) -> NoReturn:
        print(f"{self.prog}: {message} (see {self.prog} --help)", file=sys.stderr)
        raise SystemExit(2)


def command(
    commands: Any,
    name: str,
    run: Callable[..., int],
    summary: str,
    description: str,
    example: str,
) -> argparse.ArgumentParser:
    """Adds a command.

    Args:
        commands: as `add_subparsers` returns it.
        name: of the command.
        run: called with the options and a console; returns the exit status.
        summary: its line in the list of commands.
        description: what it does, in a paragraph.
        example: a command line.
    """
    parser = commands.add_parser(
        name,
        help=summary,
        description=description,
        epilog=f"example:\n  {example}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run)
    return parser


def positive(text: str) -> int:
    """A whole number above 0."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number above 0")
    return int(text)


def between(low: int, high: int) -> Callable[[str], int]:
    """A whole number from `low` to `high`."""

    def number(text: str) -> int:
        if not text.isdecimal() or not low <= int(text) <= high:
            raise argparse.ArgumentTypeError(f"{text!r} is not a whole number {low} to {high}")
        return int(text)

    return number
