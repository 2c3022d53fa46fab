"""Runs the command that was typed, and turns errors into one line and an exit status."""

import io
import logging
import os
import sys
import warnings
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from importlib.metadata import version

from emberlink.envs.utils.errors import UserError, one_line, unknown
from emberlink.trainers.cli import commands as of
from emberlink.trainers.cli.fire import add_fire
from emberlink.trainers.cli.list import add_list
from emberlink.trainers.cli.parser import Parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a command and returns its exit status, which is 2 for a mistake of the user.

    Errors that are neither the user's nor the system's end in a traceback.
    """
    if sys.platform == "win32":
        return _report("emberlink", "runs on Linux and macOS; on Windows, use WSL")
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # for characters that the encoding lacks
    printed: set[str] = set()
    warnings.formatwarning = partial(_on_one_line, warnings.formatwarning, printed)
    words = list(sys.argv[1:] if arguments is None else arguments)
    parser, names = _parser()
    if not words:
        parser.print_help()
        return 0
    if not words[0].startswith("-") and words[0] not in names:
        parser.error(f"command {unknown(words[0], names)}")
    options = parser.parse_args(words)
    program = f"emberlink {options.command}"
    # torchrl's messages of level INFO would disturb the progress bar.
    os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")
    logging.getLogger("matplotlib").setLevel(logging.ERROR)  # of a cache in no home folder
    try:
        from emberlink.trainers.terminal.console import PlainConsole

        return options.run(options, PlainConsole())
    except KeyboardInterrupt:
        return _report(program, "stopped", 130)
    except UserError as error:
        return _report(program, str(error))
    except OSError as error:
        return _report(program, f"{error.filename or 'a file'}: {error.strerror or error}")
    except RuntimeError as error:
        # PyTorch has no error class for memory of the CPU.
        if "DefaultCPUAllocator" in str(error) or type(error).__name__ == "OutOfMemoryError":
            return _report(program, f"not enough memory: {str(error).splitlines()[0]}")
        raise


def _report(program: str, message: str, status: int = 2) -> int:
    """Prints a message on one line and returns the exit status."""
    with suppress(OSError):  # the terminal may be gone
        print(f"{program}: {one_line(message)}", file=sys.stderr)
    return status


def _parser() -> tuple[Parser, list[str]]:
    """Returns the parser and the names of the commands."""
    parser = Parser(
        prog="emberlink",
        description="Teams of UAVs that learn to find and cover a spreading wildfire.",
    )
    parser.add_argument("--version", action="version", version=f"emberlink {version('emberlink')}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for add in (
        *(of.add_train, of.add_eval, of.add_export, of.add_compare, of.add_render),
        *(of.add_sweep, of.add_tune, add_fire, of.add_world, add_list, of.add_doctor),
    ):
        add(commands)
    return parser, list(commands.choices)


def _on_one_line(otherwise, printed: set[str], message, category, *place) -> str:
    """Formats a `UserWarning` as `emberlink: warning: ...`, or as nothing if it was printed."""
    if not issubclass(category, UserWarning):
        return otherwise(message, category, *place)
    text = one_line(str(message))
    line = "" if text in printed else f"emberlink: warning: {text}\n"
    printed.add(text)
    return line
