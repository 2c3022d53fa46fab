"""Defines the arguments of `emberlink doctor`."""

import argparse
from typing import TYPE_CHECKING, Any

from emberlink.trainers.cli.parser import command

if TYPE_CHECKING:
    from rich.console import Console


def add_doctor(commands: Any) -> None:
    """Adds the command to the parser."""
    command(
        commands,
        "doctor",
        _doctor,
        "check the installation",
        "Prints versions and devices and runs a self-test: a short fire, the environment of every "
        "method, and updates of its networks. Prints how long the self-test took.",
        "emberlink doctor",
    )


def _doctor(options: argparse.Namespace, console: "Console") -> int:
    from emberlink.trainers.training.self_test import doctor

    return doctor(console)
