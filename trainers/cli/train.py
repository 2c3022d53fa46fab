"""Defines the arguments of `emberlink train`."""

import argparse
from typing import TYPE_CHECKING, Any

from emberlink.envs.utils.errors import UserError
from emberlink.trainers.cli.parser import command

if TYPE_CHECKING:
    from rich.console import Console


def add_train(commands: Any) -> None:
    """Adds the command to the parser."""
    train = command(
        commands,
        "train",
        _train,
        "train one of the methods and evaluate it",
        "Trains a method, evaluates the frozen policies on test fires, and writes a run folder "
        "with config.yaml, metrics.jsonl, checkpoints, eval.json, figures, a GIF and a replay "
        "page.",
        "emberlink train consensus setup=tuned episodes=20 seed=1",
        usage="emberlink train METHOD [key=value ...]\n"
        "       emberlink train resume=RUN [key=value ...]",
    )
    train.add_argument(
        "method",
        metavar="METHOD",
        help="a method: independent, shared_memory, positional, consensus, maps, or your own "
        "(see emberlink list methods); or resume=RUN, to resume the training of a run folder",
    )
    train.add_argument(
        "overrides",
        metavar="key=value",
        nargs="*",
        default=[],
        help="any key of configs/base.yaml or of the chosen setup, such as setup=tuned, "
        "fire=huygens, seed=1, env.num_uavs=3, logger=csv",
    )


def _train(options: argparse.Namespace, console: "Console") -> int:
    _check_names(options.method, options.overrides)
    # Commands import their code when they run, so that `--help` does not import torch.
    from emberlink.trainers.training.command import train

    return train(options.method, options.overrides, console)


def _check_names(method: str, overrides: list[str]) -> None:
    """Reports a wrong name or key before torch is imported, which takes seconds."""
    from emberlink.envs.utils.config_files import find

    if any(text.startswith("resume=") for text in (method, *overrides)):
        return
    find("method", method)
    if other := next((text for text in overrides if "=" not in text), None):
        raise UserError(
            f"{other!r} is not of the form key=value; several methods: emberlink sweep "
            f"{method} {other} ..."
        )
    from emberlink.trainers.config.values import composed  # imports Hydra

    composed(method, overrides)
