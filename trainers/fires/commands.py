"""Runs `emberlink fire`: draws fires, and joins files of fires in one bank."""

import io
import os
import re
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from rich.console import Console

from emberlink.envs.fire.generator import scenarios
from emberlink.envs.fire_files.config import FileFireConfig
from emberlink.envs.fire_files.reader import read_with_summary
from emberlink.envs.scenarios import fires_of
from emberlink.envs.utils.atomic_io import created, free_name, new_file, user_path
from emberlink.envs.utils.errors import UserError, shown, unknown
from emberlink.envs.utils.validation import is_index
from emberlink.envs.world.coverage_map import split_times
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.config.schema import MAX_FIRES, RunConfig
from emberlink.trainers.fires.plot import arrival_figure


def preview(arguments: Sequence[str], console: Console, output: Path | None = None) -> int:
    """Draws a fire, SCENARIO or FILE (and :INDEX) or `fire=NAME`, and prints its numbers."""
    path = new_file(output, [".png"]) if output is not None and not os.path.isdir(output) else None
    sources, overrides = _divided(arguments)
    if len(sources) + any(text.startswith("fire=") for text in overrides) != 1:
        raise UserError(f"{shown(' '.join(sources))!r}: expected one scenario or file")
    text, index = sources[0] if sources else "", "0"
    if ":" in text and not os.path.exists(text):
        text, _, index = text.rpartition(":")
    config = _config(overrides, text)
    fire, world = config.fire, config.env
    fires, name, count, about = None, fire.name, MAX_FIRES, []
    if isinstance(fire, FileFireConfig):
        fires, read = read_with_summary(fire, world.grid, world.horizon)
        name, count, about = Path(fire.path).name, len(fires), [f"read: {read}"]
    if not is_index(index, count):
        raise UserError(f"{shown(name)}: no fire {shown(index)!r}; known: 0 to {count - 1}")
    if fires is None:
        drawn = fires_of(fire).test_fire(int(index), world.grid, world.horizon)
        arrival, title = split_times(drawn)[0][0].numpy(), f"{name}, test fire {index}"
    else:
        arrival, title = fires[int(index)].numpy(), f"{name}, fire {index} of {count}"
    if path is None:
        stem = re.sub(r"[^\w.+-]", "-", f"fire_{Path(name).stem}_{index}")[:100]
        path = Path(f"{free_name(output or Path(), stem, ['.png'])}.png")
    with created(path) as partial, warnings.catch_warnings(action="ignore"):  # of missing letters
        arrival_figure(partial, arrival, world.horizon, shown(title))
    grid = " x ".join(map(str, world.grid))
    first = f"{shown(title)}: {grid} cells, {world.horizon} steps, setup {config.setup}"
    begin, end = ((arrival <= step).sum() for step in (0, world.horizon))
    _print(console, first, *about, f"{begin} cells burn by step 0, {end} at the end", str(path))
    return 0


def import_files(arguments: Sequence[str], console: Console, output: Path) -> int:
    """Reads files of fires, prints its reading of each, and writes them to a bank.

    A bank is an .npy of steps, float32 [fires, X, Y], inf for never.
    """
    paths, overrides = _divided(arguments)
    output, fires = new_file(output, [".npy"]), []
    for path in paths:
        config = _config(overrides, path)
        if not isinstance(config.fire, FileFireConfig):
            raise UserError(f"{shown(path)} is a scenario; expected a file")
        read, about = read_with_summary(config.fire, config.env.grid, config.env.horizon)
        _print(console, f"{Path(path).name}: read: {about}")
        fires.append(read)
    if not fires:
        raise UserError("FILE is missing; expected a file, such as ArrivalTime.asc")
    bank, memory = torch.cat(fires), io.BytesIO()
    np.save(memory, bank.numpy())  # in memory first: NumPy does not report a full disk
    with created(output) as partial:
        partial.write_bytes(memory.getbuffer())
    count, across, up = bank.shape
    _print(console, f"{count} fires of {across} x {up} cells, in steps", str(output))
    return 0


def _divided(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Returns sources and `key=value`; an existing file takes precedence over a key."""
    keys = [text for text in arguments if "=" in text and not os.path.exists(text)]
    return [str(user_path(text)) for text in arguments if text not in keys], keys


def _config(overrides: Sequence[str], source: str) -> RunConfig:
    """Returns the configuration of a scenario or a file, or of the `fire=` among the keys."""
    known = source in scenarios()
    if source and not known and not os.path.exists(source):
        hint = unknown(source, scenarios())
        raise UserError(f"{shown(source)}: there is no such file; as a scenario {hint}")
    name = [f"fire={source if known else 'file'}"] if source else []
    # The path bypasses the parser of overrides, in which some characters have a meaning.
    keys = {"fire.path": source} if source and not known else {}
    return resolve("independent", [*name, *overrides], **keys)  # any method


def _print(console: Console, *lines: str) -> None:
    for line in lines:
        console.print(line, soft_wrap=True, highlight=False, markup=False)
