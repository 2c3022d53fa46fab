"""The command line: emberlink train, eval, doctor."""

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from rich.console import Console

INTERRUPTED = 130
"""the exit status of a program that Ctrl-C ended"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command and returns its exit status: 0, or 2 for a mistake of the user's."""
    options = _parser().parse_args(arguments)
    console = Console()
    # What torchrl says of its own doings would break into the progress bar.
    os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")
    try:
        return options.run(options, console)
    except ValueError as error:
        print(f"emberlink {options.command}: {error}", file=sys.stderr)
        return 2
    except RuntimeError as error:
        if "alloc" not in str(error):
            raise
        reason = str(error).splitlines()[0]
        print(f"emberlink {options.command}: not enough memory: {reason}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"emberlink {options.command}: stopped", file=sys.stderr)
        return INTERRUPTED


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line, where argparse would print the usage before it."""

    def error(self, message: str) -> NoReturn:
        print(f"{self.prog}: {message} (see {self.prog} --help)", file=sys.stderr)
        raise SystemExit(2)


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="emberlink",
        description="Teams of UAVs that learn to find and cover a spreading wildfire.",
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    train = _command(
        commands,
        "train",
        _train,
        "train one of the methods and evaluate it",
        "Trains a method, evaluates the frozen policies on held-out fires, and leaves a run "
        "folder with config.yaml, metrics.jsonl, checkpoints, eval.json, figures and a GIF.",
        "emberlink train consensus setup=tuned episodes=20 seed=1",
    )
    train.add_argument("method", metavar="METHOD", help="a file in configs/method: consensus, ...")
    train.add_argument(
        "overrides",
        metavar="key=value",
        nargs="*",
        help="any key of configs/base.yaml or of the chosen setup, such as setup=tuned, "
        "fire=huygens, seed=1, env.num_uavs=3, logger=csv",
    )
    evaluation = _command(
        commands,
        "eval",
        _eval,
        "evaluate a run's frozen policies",
        "Loads the newest checkpoint of a run, plays the frozen policies and the scripted ones on "
        "the same held-out fires, prints the table, and leaves eval.json, figures and a GIF in "
        "the run folder.",
        "emberlink eval runs/2026-01-31_12-00-00_consensus_tuned_s0 --fires 64",
    )
    evaluation.add_argument("folder", metavar="RUN", type=Path, help="a run folder")
    evaluation.add_argument("--checkpoint", type=Path, help="another than the newest")
    evaluation.add_argument(
        "--fires", type=_positive, help="episodes; as the run has it if left out"
    )
    evaluation.add_argument("--device", help="another than the run's")
    _command(
        commands,
        "doctor",
        _doctor,
        "check the installation",
        "Prints versions and devices and runs a self-test of about five seconds: a short fire, "
        "every recipe's environment, and one update of its networks.",
        "emberlink doctor",
    )
    return parser


def _command(commands, name, run, summary, description, example) -> argparse.ArgumentParser:
    parser = commands.add_parser(
        name,
        help=summary,
        description=description,
        epilog=f"example:\n  {example}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run)
    return parser


def _positive(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number above 0")
    return int(text)


# The commands import what they need when they run: `emberlink --help` need not wait for torch.


def _train(options: argparse.Namespace, console: Console) -> int:
    from .commands import train

    return train(options.method, options.overrides, console)


def _eval(options: argparse.Namespace, console: Console) -> int:
    from .commands import evaluate_folder

    return evaluate_folder(
        options.folder,
        console,
        checkpoint=options.checkpoint,
        fires=options.fires,
        device=options.device,
    )


def _doctor(options: argparse.Namespace, console: Console) -> int:
    from .doctor import doctor

    return doctor(console)
