"""Finds the fire that a command names: a test fire of a scenario, or a fire of a file."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from emberlink.envs.fire.generator import scenarios
from emberlink.envs.fire_files.config import FileFireConfig
from emberlink.envs.fire_files.reader import read_with_summary
from emberlink.envs.scenarios import fires_of
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import is_index, shown, unknown
from emberlink.envs.world.burning import split_times
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.config.schema import MAX_FIRES, RunConfig

FILE = "file"
"""name of the scenario of fires that are read from a file"""
_METHOD = "independent"  # any method; fires do not depend on it
_KEYS = ("env.", "fire.")


@dataclass(frozen=True, kw_only=True)
class SelectedFire:
    """A fire and its origin."""

    title: str
    stem: str
    """beginning of the names of files about the fire"""
    config: RunConfig
    arrival: Tensor
    """float32 [X, Y], steps"""
    summary: str = ""
    """description of the file; empty for a scenario"""


def find_fire(text: str, overrides: Sequence[str]) -> SelectedFire:
    """Returns the fire that NAME, NAME:INDEX, FILE or FILE:INDEX names.

    Args:
        text: the name of a scenario or a path. A scenario takes precedence.
        overrides: `key=value` of setup, env. and fire.

    Raises:
        UserError: there is no such fire, or a key or value is wrong.
    """
    name, _, index = text.rpartition(":") if ":" in text else (text, "", "0")
    if name in scenarios():
        config = generated(name, overrides)
        return SelectedFire(
            title=f"{name}, test fire {index}",
            stem=f"fire_{name}_{index}",
            config=config,
            arrival=_test_fire(config, text, index),
        )
    if os.path.exists(text) or not os.path.exists(name):
        name, index = text, "0"
    if not name or not os.path.exists(name):
        known = unknown(text.rpartition(":")[0] or text, scenarios())
        raise UserError(f"{shown(text)}: there is no such file; as a scenario {known}")
    path = Path(name)
    config = from_file(path, overrides)
    fires, summary = read(config)
    if not is_index(index, len(fires)):
        raise UserError(
            f"{shown(text)}: there is no fire {shown(index)!r}; known: 0 to {len(fires) - 1}"
        )
    several, shortened = len(fires) > 1, shown(path.name)
    return SelectedFire(
        title=f"{shortened}, fire {index} of {len(fires)}" if several else shortened,
        stem=f"fire_{path.stem}_{index}" if several else f"fire_{path.stem}",
        config=config,
        arrival=fires[int(index)],
        summary=summary,
    )


def _test_fire(config: RunConfig, text: str, index: str) -> Tensor:
    if not is_index(index, MAX_FIRES):
        raise UserError(
            f"{shown(text)}: there is no test fire {shown(index)!r}; known: 0 to {MAX_FIRES - 1}"
        )
    fire = fires_of(config.fire).test_fire(int(index), config.env.grid, config.env.horizon)
    return split_times(fire)[0][0]


def generated(scenario: str, overrides: Sequence[str]) -> RunConfig:
    """Returns the configuration with which a scenario's fires are made.

    Raises:
        UserError: there is no such scenario, it reads a file, or a key or value is wrong.
    """
    if scenario not in scenarios():
        raise UserError(f"fire {unknown(scenario, scenarios())}")
    return _resolve([f"fire={scenario}", *overrides], overrides)


def from_file(path: Path, overrides: Sequence[str]) -> RunConfig:
    """Returns the configuration with which a file is read.

    Raises:
        UserError: a key or value is wrong.
    """
    if any(text.partition("=")[0] == "fire.path" for text in overrides):
        raise UserError("fire.path: the file is given without a key here")
    # The path bypasses the parser of overrides, in which some characters have a meaning.
    return _resolve([f"fire={FILE}", "fire.path=_", *overrides], overrides, path=str(path))


def _resolve(texts: Sequence[str], overrides: Sequence[str], path: str | None = None) -> RunConfig:
    settings: dict[str, Any] = {} if path is None else {"fire.path": path}
    config = resolve(_METHOD, texts, **settings)
    for text in overrides:
        key = text.partition("=")[0]
        if key == "fire":
            raise UserError(f"{shown(text)!r}: the fire is given without a key here")
        if key != "setup" and not key.startswith(_KEYS):
            raise UserError(
                f"{shown(text)!r}: a fire depends on keys of setup, env. and fire. only"
            )
    return config


def read(config: RunConfig) -> tuple[Tensor, str]:
    """Returns the fires of a file, float32 [fires, X, Y], steps, and a description of the file.

    Raises:
        UserError: one line that names the file and the mistake in it.
    """
    assert isinstance(config.fire, FileFireConfig)
    return read_with_summary(config.fire, config.env.grid, config.env.horizon)
