"""Defines the parser of the command line, its one-line errors, and functions shared by commands."""

import argparse
import difflib
import sys
from collections.abc import Callable
from contextlib import suppress
from typing import Any, NoReturn

MOST_FIRES = 65_536
"""largest number of fires of an evaluation; that of `config.schema`, which imports torch"""


class _Help(argparse.HelpFormatter):
    """Wraps descriptions to the width of the terminal and leaves examples as they are."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        return text if text.startswith("example:") else super()._fill_text(text, width, indent)


class Parser(argparse.ArgumentParser):
    """Parses arguments and prints errors on one line, without the usage.

    Options and other arguments of a command may be in any order.
    """

    _is_intermixed = False

    def parse_known_args(self, args=None, namespace=None):  # pyright: ignore
        """Parses as argparse does; unknown options are errors."""
        if self._is_intermixed or self._subparsers is not None:
            return super().parse_known_args(args, namespace)
        self._is_intermixed = True  # parse_known_intermixed_args calls this method
        try:
            parsed, unknown = self.parse_known_intermixed_args(args, namespace)
        finally:
            self._is_intermixed = False
        for text in unknown:
            if text.startswith("-"):
                self.error(f"option {text} is not known{self._hint(text)}")
        return parsed, unknown

    def _print_message(self, message: str, file: Any = None) -> None:
        """Writes a message; argparse itself would not report that it cannot be written."""
        if stream := file or sys.stderr:
            stream.write(message)

    def error(self, message: str) -> NoReturn:
        """Prints the message and exits with status 2."""
        text = "".join(c if c.isprintable() else "?" for c in message)
        with suppress(OSError):  # the terminal may be gone
            print(f"{self.prog}: {text} (see {self.prog} --help)", file=sys.stderr)
        raise SystemExit(2)

    def _hint(self, text: str) -> str:
        """Returns the most similar option, or that settings are given as key=value."""
        options = [option for action in self._actions for option in action.option_strings]
        near = difflib.get_close_matches(text.partition("=")[0], options, n=1)
        if near:
            return f"; did you mean {near[0]}?"
        keys = any("key=value" in str(action.metavar) for action in self._actions)
        return "; settings are given as key=value" if keys else ""


def command(
    commands: Any,
    name: str,
    run: Callable[..., int],
    summary: str,
    description: str,
    example: str,
    usage: str | None = None,
) -> Parser:
    """Adds a command and returns its parser.

    Args:
        commands: result of `add_subparsers`.
        name: name of the command.
        run: called with the options and a console; returns the exit status.
        summary: text in the list of commands.
        description: description of the command.
        example: example of a command line.
        usage: usage of the command; generated from its arguments if None.
    """
    parser = commands.add_parser(
        name,
        help=summary,
        description=description,
        epilog=f"example:\n  {example}",
        usage=usage,
        formatter_class=_Help,
    )
    parser.set_defaults(run=run)
    return parser


def command_group(commands: Any, name: str, summary: str, description: str, example: str) -> Any:
    """Adds a command with subcommands, which alone prints its help; returns their group.

    Arguments are those of `command`.
    """

    def print_help(_: argparse.Namespace, console: Any) -> int:
        console.print(group.format_help(), soft_wrap=True, end="")
        return 0

    group = command(commands, name, print_help, summary, description, example)
    return group.add_subparsers(dest="action", metavar="ACTION")


def positive(text: str) -> int:
    """Converts an argument to a whole number above 0."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number above 0")
    return int(text)


def between(low: int, high: int) -> Callable[[str], int]:
    """Returns a converter of arguments to whole numbers from `low` to `high`."""

    def number(text: str) -> int:
        if not text.isdecimal() or not low <= int(text) <= high:
            raise argparse.ArgumentTypeError(f"{text!r} is not a whole number {low} to {high}")
        return int(text)

    return number
