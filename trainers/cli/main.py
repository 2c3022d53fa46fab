"""Runs the command that was typed, and turns errors into one line and an exit status."""

import argparse
import errno
import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

from emberlink.trainers.cli.compare import add_compare
from emberlink.trainers.cli.completion import SHELLS, PrintScript, answer
from emberlink.trainers.cli.doctor import add_doctor
from emberlink.trainers.cli.eval import add_eval
from emberlink.trainers.cli.fire import add_fire
from emberlink.trainers.cli.list import add_list
from emberlink.trainers.cli.parser import Parser
from emberlink.trainers.cli.render import add_render
from emberlink.trainers.cli.sweep import add_sweep
from emberlink.trainers.cli.train import add_train
from emberlink.trainers.cli.world import add_world
from emberlink.trainers.terminal.warning_lines import one_line_warnings

INTERRUPTED = 130
"""exit status after Ctrl-C"""
_BROKEN_PIPE = 141
"""exit status of shells after a closed pipe"""
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EIO)
"""errors of full or broken disks"""
_OF_PATHS = (errno.EACCES, errno.EPERM, errno.ENAMETOOLONG, errno.ELOOP, errno.EROFS)
"""errors of paths that the user gave: without access, too long, links in a circle, read-only"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a command and returns its exit status, which is 2 for a mistake of the user.

    The status is 1 if standard output cannot be written. Only defects of the program end in a
    traceback.
    """
    if sys.platform == "win32":
        print("emberlink: runs on Linux and macOS; on Windows, use WSL", file=sys.stderr)
        return 2
    try:
        with one_line_warnings():
            status = _parse_and_run(arguments)
    except SystemExit as ended:  # of argparse, after a help or an error
        raise SystemExit(_flush(int(ended.code or 0))) from None
    except BaseException:
        _flush(1)
        raise
    return _flush(status)


def _parse_and_run(arguments: Sequence[str] | None) -> int:
    parser = _parser()
    if "_ARGCOMPLETE" in os.environ:  # of the script that --completion prints
        answer(parser)
    try:
        options = parser.parse_args(arguments)
        if options.command is None:
            parser.print_help()
            return 0
    except OSError as error:  # of a help or the version
        return _unwritable("emberlink", error)
    return _run(options)


def _run(options: argparse.Namespace) -> int:
    # torchrl's messages of level INFO would disturb the progress bar.
    os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")
    try:
        # Imported here, since Ctrl-C during the import must end in one line, too.
        from emberlink.trainers.terminal import SafeConsole

        return options.run(options, SafeConsole())
    except KeyboardInterrupt:
        return _report(options, "stopped", INTERRUPTED)
    except OSError as error:
        if error.errno == errno.EPIPE:
            return _BROKEN_PIPE
        if _is_output(error):
            return _unwritable(f"emberlink {options.command}", error)
        if error.errno not in (*_FULL, *_OF_PATHS):
            raise
        name = error.filename or "a file"
        what = "cannot be written: " if error.errno in _FULL else ""
        return _report(options, f"{name}: {what}{error.strerror}")
    except Exception as error:
        message = _message(error)
        if message is None:
            raise
        return _report(options, message)


def _message(error: Exception) -> str | None:
    """Returns the message of a user's mistake; None for a defect of the program."""
    from emberlink.envs.utils.errors import UserError

    if isinstance(error, UserError):
        return str(error)
    # PyTorch has no error of its own for memory of the CPU.
    allocator = "DefaultCPUAllocator" in str(error) or type(error).__name__ == "OutOfMemoryError"
    if isinstance(error, RuntimeError) and allocator:
        return f"not enough memory: {str(error).splitlines()[0]}"
    return None


def _is_output(error: OSError) -> bool:
    from emberlink.trainers.terminal import OutputError

    return isinstance(error, OutputError)


def _report(options: argparse.Namespace, message: str, status: int = 2) -> int:
    """Prints a message on one line and returns the exit status."""
    line = "".join(c if c.isprintable() else " " for c in " ".join(message.split()))
    with suppress(OSError):  # the terminal may be gone
        print(f"emberlink {options.command}: {line}", file=sys.stderr)
    return status


def _unwritable(program: str, error: OSError) -> int:
    """Reports that standard output cannot be written and returns the exit status."""
    if error.errno == errno.EPIPE:
        return _BROKEN_PIPE
    with suppress(OSError):
        reason = error.strerror or error
        print(f"{program}: standard output: cannot be written: {reason}", file=sys.stderr)
    return 1


def _flush(status: int) -> int:
    """Flushes standard output and returns the exit status.

    An output that cannot be flushed is discarded, so that Python does not report it at its end.
    """
    if sys.stdout is None:  # closed by the shell: >&-
        return status
    try:
        sys.stdout.flush()
    except OSError as error:
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, sys.stdout.fileno())
        os.close(null)
        return status or _unwritable("emberlink", error)
    return status


def _parser() -> Parser:
    parser = Parser(
        prog="emberlink",
        description="Teams of UAVs that learn to find and cover a spreading wildfire.",
        epilog="Runs on Linux and macOS.",
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    parser.add_argument(
        "--completion",
        action=PrintScript,
        choices=SHELLS,
        help="print a completion script, which the shell evaluates, and exit",
    )
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")
    for add in (
        *(add_train, add_eval, add_compare, add_render),
        *(add_sweep, add_fire, add_world, add_list, add_doctor),
    ):
        add(commands)
    return parser


class _Version(argparse.Action):
    """Prints the version of the installed package."""

    def __call__(self, parser: Any, *_: object) -> None:
        from importlib.metadata import version

        parser._print_message(f"emberlink {version('emberlink')}\n", sys.stdout)
        parser.exit()
