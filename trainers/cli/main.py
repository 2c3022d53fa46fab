"""Runs the command that was typed, and turns errors into one line and an exit status."""

import argparse
import errno
import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

from emberlink.envs.utils.errors import UserError, unknown
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
        return _report("emberlink", "runs on Linux and macOS; on Windows, use WSL")
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        with one_line_warnings():
            return _flush(_run(words))
    except SystemExit as ended:  # of argparse, after a help or an error
        raise SystemExit(_flush(int(ended.code or 0))) from None
    except OSError as error:  # of a help or the version
        error.filename = error.filename or "standard output"
        return _of_system("emberlink", error)


def _run(words: list[str]) -> int:
    parser, names = _parser()
    if "_ARGCOMPLETE" in os.environ:  # of the script that --completion prints
        answer(parser)
    if not words:
        parser.print_help()
        return 0
    if not words[0].startswith("-") and words[0] not in names:
        parser.error(f"command {unknown(words[0], names)}")
    options = parser.parse_args(words)
    program = f"emberlink {options.command}"
    # torchrl's messages of level INFO would disturb the progress bar.
    os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")
    try:
        from emberlink.trainers.terminal.console import SafeConsole

        return options.run(options, SafeConsole())
    except KeyboardInterrupt:
        return _report(program, "stopped", INTERRUPTED)
    except UserError as error:
        return _report(program, str(error))
    except OSError as error:
        return _of_system(program, error)
    except RuntimeError as error:
        # PyTorch has no error of its own for memory of the CPU.
        if "DefaultCPUAllocator" in str(error) or type(error).__name__ == "OutOfMemoryError":
            return _report(program, f"not enough memory: {str(error).splitlines()[0]}")
        raise


def _of_system(program: str, error: OSError) -> int:
    """Reports an error of the output, of a full disk or of a path; others are defects."""
    if error.errno == errno.EPIPE:
        return _BROKEN_PIPE
    if error.errno not in (*_FULL, *_OF_PATHS, errno.EBADF):
        raise error
    status = 1 if error.filename == "standard output" else 2
    written = "cannot be written: " if error.errno in _FULL or status == 1 else ""
    return _report(program, f"{error.filename or 'a file'}: {written}{error.strerror}", status)


def _report(program: str, message: str, status: int = 2) -> int:
    """Prints a message on one line and returns the exit status."""
    line = "".join(c if c.isprintable() else " " for c in " ".join(message.split()))
    with suppress(OSError):  # the terminal may be gone
        print(f"{program}: {line}", file=sys.stderr)
    return status


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
        error.filename = "standard output"
        return status or _of_system("emberlink", error)
    return status


def _parser() -> tuple[Parser, list[str]]:
    """Returns the parser and the names of the commands."""
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
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for add in (
        *(add_train, add_eval, add_compare, add_render),
        *(add_sweep, add_fire, add_world, add_list, add_doctor),
    ):
        add(commands)
    return parser, list(commands.choices)


class _Version(argparse.Action):
    """Prints the version of the installed package."""

    def __call__(self, parser: Any, *_: object) -> None:
        from importlib.metadata import version

        print(f"emberlink {version('emberlink')}")
        parser.exit()
