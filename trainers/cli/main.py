"""The command line: emberlink train, eval, compare, render, sweep, fire, doctor."""

import argparse
import errno
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from .fire import add_fire
from .parser import Parser, between, command, positive

if TYPE_CHECKING:
    from rich.console import Console

INTERRUPTED = 130
"""the exit status of a program that Ctrl-C ended"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command and returns its exit status: 0, or 2 for a mistake of the user's."""
    options = _parser().parse_args(arguments)
    # What torchrl says of its own doings would break into the progress bar.
    os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")
    try:
        # Here, as all that takes time, so that an early Ctrl-C ends in one line as well.
        from rich.console import Console

        # Names of folders are shown as they are, brackets and colons included.
        return options.run(options, Console(markup=False, emoji=False))
    except ValueError as error:
        print(f"emberlink {options.command}: {_one_line(error)}", file=sys.stderr)
        return 2
    except RuntimeError as error:
        if "alloc" not in str(error):
            raise
        reason = str(error).splitlines()[0]
        print(f"emberlink {options.command}: not enough memory: {reason}", file=sys.stderr)
        return 2
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        print(f"emberlink {options.command}: cannot write: {error.strerror}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"emberlink {options.command}: stopped", file=sys.stderr)
        return INTERRUPTED


def _one_line(error: ValueError) -> str:
    return "".join(c if c.isprintable() else " " for c in " ".join(str(error).split()))


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog="emberlink",
        description="Teams of UAVs that learn to find and cover a spreading wildfire.",
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    train = command(
        commands,
        "train",
        _train,
        "train one of the methods and evaluate it",
        "Trains a method, evaluates the frozen policies on held-out fires, and leaves a run "
        "folder with config.yaml, metrics.jsonl, checkpoints, eval.json, figures and a GIF.",
        "emberlink train consensus setup=tuned episodes=20 seed=1",
    )
    train.add_argument(
        "method",
        metavar="METHOD",
        help="a file in configs/method: consensus, ...; or resume=RUN, to go on with a run folder",
    )
    train.add_argument(
        "overrides",
        metavar="key=value",
        nargs="*",
        help="any key of configs/base.yaml or of the chosen setup, such as setup=tuned, "
        "fire=huygens, seed=1, env.num_uavs=3, logger=csv",
    )
    evaluation = command(
        commands,
        "eval",
        _eval,
        "evaluate a run's frozen policies",
        "Loads the newest checkpoint of a run, plays the frozen policies and the scripted ones on "
        "the same held-out fires, prints the table, and leaves eval.json, figures and a GIF in "
        "the run folder.",
        "emberlink eval runs/2026-01-31_12-00-00_consensus_tuned_s0 --fires 64",
    )
    evaluation.add_argument(
        "folder", metavar="RUN", help="a run folder, or pretrained:METHOD, pretrained:SETUP/METHOD"
    )
    evaluation.add_argument(
        "overrides",
        metavar="key=value",
        nargs="*",
        help="keys of comm. or env. in place of the run's, such as comm.loss=0.5; "
        "the files are named after them",
    )
    evaluation.add_argument("--checkpoint", type=Path, help="another than the newest")
    evaluation.add_argument(
        "--fires", type=positive, help="episodes; as the run has it if left out"
    )
    evaluation.add_argument("--device", help="another than the run's")
    comparison = command(
        commands,
        "compare",
        _compare,
        "compare runs: methods, setups, several seeds",
        "Gathers finished runs by setup and method and prints interquartile means with 95 % "
        "bootstrap intervals over training seeds, and the paper's claims; leaves a new folder with "
        "compare.html (tables, the paper's figures 5 to 9, timelapses), compare.json and the PNGs.",
        "emberlink compare runs/ --output comparison",
    )
    comparison.add_argument(
        "folders",
        metavar="RUN",
        nargs="+",
        type=Path,
        help="run folders, or folders that hold some",
    )
    comparison.add_argument(
        "--output", metavar="FOLDER", type=Path, help="a new folder; compare if left out"
    )
    _add_render(commands)
    many = command(
        commands,
        "sweep",
        _sweep,
        "train methods x seeds x setups",
        "Trains and evaluates every combination, several runs at a time on the cores that are "
        "there. Runs in the output folder that are finished are skipped, and those that were "
        "stopped go on: the same command again does what is left.",
        "emberlink sweep consensus positional setup=paper,tuned seed=0,1,2 output=runs",
    )
    many.add_argument(
        "arguments",
        metavar="METHOD | key=value,value",
        nargs="+",
        help="methods, all if none is given; keys as for train, with one value or several",
    )
    many.add_argument("--jobs", type=positive, help="runs at a time; one per core if left out")
    many.add_argument("--dry-run", action="store_true", help="only say what would be done")
    add_fire(commands)
    command(
        commands,
        "doctor",
        _doctor,
        "check the installation",
        "Prints versions and devices and runs a self-test of about five seconds: a short fire, "
        "every recipe's environment, and one update of its networks.",
        "emberlink doctor",
    )
    return parser


def _add_render(commands) -> None:
    rendering = command(
        commands,
        "render",
        _render,
        "an episode as GIF and MP4; several runs side by side",
        "Plays the frozen policies of one or more runs on the same held-out fire from the same "
        "start positions, and draws fire, UAVs, their roles and the links of their network. Leaves "
        "a GIF and an MP4 in the first run's figures, under names that are free.",
        "emberlink render runs/2026-01-31_12-00-00_consensus_tuned_s0 --policy random_waypoints",
    )
    add = rendering.add_argument
    add("runs", metavar="RUN", nargs="+", help="a run folder")
    add(
        "--policy",
        metavar="NAME",
        action="append",
        default=[],
        help="a scripted policy beside the runs; may be given several times",
    )
    add(
        "--fire",
        metavar="FIRE",
        help="a held-out fire: NAME, INDEX or NAME:INDEX, such as huygens:3 (default: huygens:0, "
        "or the first of the file that the first run was trained on)",
    )
    add(
        "--checkpoint",
        metavar="FILE",
        type=Path,
        action="append",
        default=[],
        help="another than the newest; as many as there are runs",
    )
    add(
        "--output",
        metavar="PATH",
        type=Path,
        help="a folder, or a new file that ends in .gif, .mp4 or .png (one picture)",
    )
    add("--step", metavar="STEP", type=_step, help="of a .png; the last if left out")
    add("--frames", type=positive, default=126, help="at most (default: 126)")
    add("--fps", type=_fps, default=12, help="frames per second, 1 to 50 (default: 12)")
    add("--size", type=_size, help="pixels of a map's longer side, 100 to 2000")
    add("--seen", action="store_true", help="draw fire that a UAV has seen grey")


_step, _fps, _size = between(0, 1_000_000), between(1, 50), between(100, 2000)


# The commands import what they need when they run: `emberlink --help` need not wait for torch.


def _train(options: argparse.Namespace, console: "Console") -> int:
    from .train_eval import train

    return train(options.method, options.overrides, console)


def _eval(options: argparse.Namespace, console: "Console") -> int:
    from .train_eval import evaluate_folder

    return evaluate_folder(
        options.folder,
        console,
        overrides=options.overrides,
        checkpoint=options.checkpoint,
        fires=options.fires,
        device=options.device,
    )


def _compare(options: argparse.Namespace, console: "Console") -> int:
    from emberlink.trainers.comparison.command import compare

    return compare(options.folders, console, options.output)


def _render(options: argparse.Namespace, console: "Console") -> int:
    from .render import Choices, render

    choices = Choices(
        fire=options.fire,
        policies=options.policy,
        checkpoints=options.checkpoint,
        output=options.output,
        frames=options.frames,
        fps=options.fps,
        size=options.size,
        step=options.step,
        seen=options.seen,
    )
    return render(options.runs, console, choices)


def _sweep(options: argparse.Namespace, console: "Console") -> int:
    from emberlink.trainers.sweep.command import sweep

    return sweep(options.arguments, console, at_a_time=options.jobs, dry=options.dry_run)


def _doctor(options: argparse.Namespace, console: "Console") -> int:
    from .doctor import doctor

    return doctor(console)
