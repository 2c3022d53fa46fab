"""Runs `emberlink fire`: draws fires, and joins files of fires in one bank."""

import io
import json
import math
import os
import re
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console

from emberlink.envs.fire.generator import scenarios
from emberlink.envs.fire_files.config import FileFireConfig
from emberlink.envs.fire_files.reader import read_with_summary
from emberlink.envs.fire_files.report import counted
from emberlink.envs.scenarios import fires_of
from emberlink.envs.utils.atomic_io import created, free_name, new_file, user_path
from emberlink.envs.utils.errors import UserError, shown, unknown
from emberlink.envs.utils.validation import is_index
from emberlink.envs.world.coverage_map import split_times
from emberlink.envs.world.sensor import view_radius
from emberlink.trainers.config.basics import MAX_FIRES
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.config.schema import RunConfig
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
    fires, name, count, about = [], fire.name, MAX_FIRES, []
    if isinstance(fire, FileFireConfig):
        fires, read = read_with_summary(fire, world.grid, world.horizon)
        name, count, about = Path(fire.path).name, len(fires), [f"read: {read}"]
    if not is_index(index, count):
        raise UserError(f"{shown(name)}: no fire {shown(index)!r}; known: 0 to {count - 1}")
    if about:
        arrival = fires[int(index)]
        title = f"{name}, fire {index} of {count}" if count > 1 else name
    else:
        arrival = split_times(fires_of(fire).test_fire(int(index), world.grid, world.horizon))[0][0]
        title = f"{name}, test fire {index}"
    if path is None:
        stem = f"fire_{Path(name).stem if about else name}" + f"_{index}" * (count > 1)
        free = free_name(output or Path(), re.sub(r"[^\w.+-]", "-", stem)[:100], [".png"])
        path = free.with_name(f"{free.name}.png")
    width = 2 * view_radius(world.altitude[1], world.view_angle)
    with created(path) as partial, warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph")  # the font may lack letters of the file's name
        arrival_figure(partial, arrival.numpy(), world.horizon, width, shown(title))
    grid = " x ".join(map(str, world.grid))
    first = f"{shown(title)}: {grid} cells, {world.horizon} steps, setup {config.setup}"
    _print(console, first, *about, *_growth(arrival.numpy(), world, width), str(path))
    return 0


def import_files(arguments: Sequence[str], console: Console, output: Path) -> int:
    """Reads files of fires, prints its reading of each, and writes them to a bank.

    A bank is an .npy of steps, float32 [fires, X, Y], inf for never, with a .json of its facts.
    """
    paths, overrides = _divided(arguments)
    card = new_file(new_file(output, [".npy"]).with_suffix(".json"), [".json"])
    fires, sources, horizon = [], [], 0
    for path in paths:
        config = _config(overrides, path)
        fire, world, horizon = config.fire, config.env, config.env.horizon
        if not isinstance(fire, FileFireConfig):
            raise UserError(f"{shown(path)} is a scenario; expected a file")
        read, about = read_with_summary(fire, world.grid, horizon)
        _print(console, f"{Path(path).name}: read: {about}")
        fires.append(read)
        sources.append({"file": Path(path).name, "sha256": fire.sha256, "fires": len(read)})
        if math.isfinite(fire.burn_time):
            warnings.warn("fire.burn_time is not written; give it with the bank", stacklevel=2)
    if not fires:
        raise UserError("FILE is missing; expected a file, such as ArrivalTime.asc")
    facts = {"axes": ["fire", "x", "y"], "horizon": horizon, "sources": sources}
    bank, memory = torch.cat(fires), io.BytesIO()
    np.save(memory, bank.numpy())  # in memory first: NumPy does not report a full disk
    with created(card) as text, created(output) as partial:
        text.write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
        partial.write_bytes(memory.getbuffer())
    count, across, up = bank.shape
    _print(console, f"{counted(count, 'fire')} of {across} x {up} cells, {horizon} steps")
    _print(console, str(output))
    return 0


def _divided(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Returns sources and `key=value`; an existing file takes precedence over a key."""
    keys = [text for text in arguments if "=" in text and not os.path.exists(text)]
    return [str(user_path(text)) for text in arguments if text not in keys], keys


def _config(overrides: Sequence[str], source: str) -> RunConfig:
    """Returns the configuration of a scenario or a file, or of the `fire=` among the keys."""
    for text in overrides:
        if not text.startswith(("setup=", "env.", "fire.", "fire=")):
            raise UserError(f"{shown(text)!r}: a fire depends on keys of setup, env. and fire.")
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


def _growth(arrival: np.ndarray, world: Any, width: float) -> list[str]:
    """Returns lines about the growth of a fire, and whether the team can keep up with it."""
    window = max(1, world.horizon // 20)
    times = np.sort(arrival, axis=None)
    burning = np.searchsorted(times, np.arange(world.horizon + 1), side="right")
    gained = burning[window:] - burning[:-window]
    since, end = int(gained.argmax()), int(burning[-1])
    mean, most = (end - burning[0]) / world.horizon, float(gained[since]) / window
    uncovered = world.num_uavs * width * world.displacement
    in_view = min(end, world.num_uavs * width**2)
    steps = math.ceil(max(0.0, end - in_view) / uncovered)
    quick, enough = most <= uncovered, steps <= world.horizon
    return [
        f"burning at the start  {burning[0]} cells",
        f"burning at the end    {end} cells",
        f"growth, mean          {mean:.3g} cells/step",
        f"growth, maximum       {most:.3g} cells/step, steps {since} to {since + window}",
        f"a UAV flies           {world.displacement:.3g} cells/step",
        f"a UAV sees            {width:.3g} cells across, from full altitude",
        f"the team uncovers     {uncovered:.3g} cells/step at most",
        f"UAVs can keep up: {'yes' if quick and enough else 'no'}",
        f"  {'-+'[quick]} the team can uncover {uncovered:.3g} cells/step, {most:.3g} burn anew",
        f"  {'-+'[enough]} of {end} cells at the end {in_view:.4g} can be in view at once; "
        f"uncovering others takes at least {steps} of {world.horizon} steps",
    ]
