"""Defines the parser of the command line, its one-line errors, and functions shared by commands."""

import argparse
import sys
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from inspect import cleandoc, signature
from pathlib import Path
from shutil import get_terminal_size
from textwrap import fill
from typing import Any, NoReturn

from emberlink.envs.utils.atomic_io import user_path
from emberlink.envs.utils.errors import UserError, one_line


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
        if text := next((text for text in unknown if text.startswith("-")), ""):
            self.error(f"option {text} is not known; settings are given as key=value")
        return parsed, unknown

    def error(self, message: str) -> NoReturn:
        """Prints the message and exits with status 2."""
        with suppress(OSError):  # the terminal may be gone
            print(f"{self.prog}: {one_line(message)} (see {self.prog} --help)", file=sys.stderr)
        raise SystemExit(2)


def command(
    commands: Any, name: str, run: Callable[..., int] | str, *texts: str, usage: str | None = None
) -> Callable[..., Any]:
    """Adds a command, such as "world check", and returns the function that adds its arguments.

    `run` is called with the options and a console, and returns the exit status; a text as for
    `run_of`. `texts` are the summary, the description and an example, or lines of all three.
    """
    summary, *description, example = cleandoc("\n".join(texts)).splitlines()
    parser = commands.add_parser(
        name.split()[-1],
        help=summary,
        description=fill(" ".join(description), get_terminal_size().columns - 2),
        epilog=f"example:\n  {example}",
        usage=usage,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )

    parser.set_defaults(run=run_of(run) if isinstance(run, str) else run, command=name)
    return parser.add_argument


def run_of(place: str) -> Callable[[argparse.Namespace, Any], int]:
    """Returns a function that imports `module:function` of emberlink.trainers and calls it.

    With a parameter `options` it gets all of them, else each as a keyword argument.
    """

    def run(options: argparse.Namespace, console: Any) -> int:
        module, _, name = place.partition(":")
        function = getattr(import_module(f"emberlink.trainers.{module}"), name)
        if "options" in signature(function).parameters:
            return function(options=options, console=console)
        own = {k: v for k, v in vars(options).items() if k not in ("run", "command", "action")}
        return function(console=console, **own)

    return run


def command_group(commands: Any, name: str, *texts: str) -> Any:
    """Adds a command with subcommands, which alone prints its help; returns their group."""
    command(commands, name, lambda *_: group.print_help() or 0, *texts)
    group = commands.choices[name]
    return group.add_subparsers(dest="action", metavar="ACTION")


def between(low: int, high: int | None = None) -> Callable[[str], int]:
    """Returns a converter of arguments to whole numbers from `low` to `high`."""

    def number(text: str) -> int:
        if not text.isdecimal() or not low <= int(text) <= (high or int(text)):
            to = f" from {low}" + (f" to {high}" if high else "")
            raise argparse.ArgumentTypeError(f"{text!r} is not a whole number{to}")
        return int(text)

    return number


positive = between(1)


def path(text: str) -> Path:
    """Converts an argument to a path; see `user_path`."""
    try:
        return user_path(text)
    except UserError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
