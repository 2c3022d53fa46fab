"""Runs `emberlink fire`: draws fires, writes generated ones to a file, joins files of fires."""

import math
import os
import re
import warnings
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from torch import Tensor

from emberlink.envs.fire.cache import GENERATOR_VERSION
from emberlink.envs.fire.generator import GeneratedConfig, Split, fire_seeds, make_fires, scenarios
from emberlink.envs.fire_files.config import FileFireConfig
from emberlink.envs.fire_files.reader import read_with_summary
from emberlink.envs.scenarios import fires_of
from emberlink.envs.utils.atomic_io import created, free_name, new_file, user_path
from emberlink.envs.utils.errors import UserError, shown, unknown
from emberlink.envs.utils.validation import is_index
from emberlink.envs.world.coverage_map import split_times
from emberlink.envs.world.sensor import view_radius
from emberlink.trainers.config.basics import MAX_FIRES
from emberlink.trainers.config.compose import resolve, to_values
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.config.values import parse
from emberlink.trainers.fires.bank_writer import check_bank, write_bank
from emberlink.trainers.fires.plot import arrival_figure


def preview(arguments: Sequence[str], console: Console, output: Path | None = None) -> int:
    """Draws a fire, SCENARIO or FILE (and :INDEX) or `fire=NAME`, and prints its numbers."""
    path = new_file(output, [".png"]) if output is not None and not os.path.isdir(output) else None
    text, overrides = _source(arguments)
    name, _, index = text.rpartition(":") if ":" in text else (text, "", "0")
    name, index = (text, "0") if os.path.exists(text) else (name, index)
    known = name in scenarios()
    if not known and not os.path.exists(name):
        hint = unknown(name, scenarios())
        raise UserError(f"{shown(text)}: there is no such file; as a scenario {hint}")
    config = _config(name, overrides) if known else _config("file", overrides, name)
    world, (fires, read) = config.env, (None, "") if known else _read(config)
    count = MAX_FIRES if fires is None else len(fires)
    if not is_index(index, count):
        raise UserError(f"{shown(text)}: no fire {shown(index)!r}; known: 0 to {count - 1}")
    if fires is None:
        fire = fires_of(config.fire).test_fire(int(index), world.grid, world.horizon)
        arrival, title, stem = split_times(fire)[0][0], f"{name}, test fire {index}", name
    else:
        arrival, title, stem = fires[int(index)], shown(Path(name).name), Path(name).stem
        title += f", fire {index} of {count}" if count > 1 else ""
    if path is None:
        stem = re.sub(r"[^\w.+-]", "-", f"fire_{stem}" + (f"_{index}" if count > 1 else ""))[:100]
        free = free_name(output or Path(), stem, [".png"])
        path = free.with_name(f"{free.name}.png")
    times, width = arrival.numpy(), 2 * view_radius(world.altitude[1], world.view_angle)
    with created(path) as partial, warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph")  # the font may lack letters of the file's name
        arrival_figure(partial, times, world.horizon, width, title)
    grid = " x ".join(map(str, world.grid))
    first = f"{title}: {grid} cells, {world.horizon} steps, setup {config.setup}"
    about = [f"read: {read}"] if read else []
    _print(console, first, *about, *_growth(times, world, width), str(path))
    return 0


def _source(arguments: Sequence[str]) -> tuple[str, list[str]]:
    """Returns the only source, and the other keys; `fire=NAME` and `fire.path=` name one, too."""
    sources, overrides = _divided(arguments)
    names = [text.partition("=")[2] for text in overrides if text.startswith("fire=")]
    keyed = [str(parse(text)[1]) for text in overrides if text.startswith("fire.path=")]
    sources += [str(user_path(text)) for text in keyed] if names == ["file"] else names
    if len(sources) != 1:
        raise UserError(f"{shown(' '.join(sources))!r}: expected one scenario or file")
    return sources[0], [text for text in overrides if not text.startswith(("fire=", "fire.path="))]


def make(
    scenario: str,
    overrides: Sequence[str],
    console: Console,
    *,
    count: int | None = None,
    split: Split = "train",
    output: Path | None = None,
) -> int:
    """Writes fires of a scenario to a new file, as many as a training or evaluation uses."""
    config = _config(scenario, overrides)
    fire, evaluation = config.fire, config.evaluation
    assert isinstance(fire, GeneratedConfig)
    usual = {"validation": evaluation.interval_episodes, "test": evaluation.episodes}
    count = count or usual.get(split, fire.num_train_fires)
    if output is None:
        name = free_name(Path(), f"{scenario}_{split}_{count}", [".npy", ".json"])
        output = name.with_name(f"{name.name}.npy")
    check_bank(output, count, config.env.grid)
    seeds = fire_seeds(split, count, fire.test_seed)
    arrival, burn_out = split_times(make_fires(fire, seeds, config.env.grid, config.env.horizon))
    facts = {"scenario": scenario, "split": split, "seeds": f"{seeds[0]} to {seeds[-1]}"}
    facts |= {**_facts(config, burn_out), "generator_version": GENERATOR_VERSION}
    _write(output, arrival, facts, [f"{scenario} {split} {n}" for n in seeds.tolist()], console)
    return 0


def import_files(arguments: Sequence[str], console: Console, output: Path) -> int:
    """Reads files of fires, prints what was understood of each, and writes them to a new one."""
    paths, overrides = _divided(arguments)
    if not paths:
        raise UserError("FILE is missing; expected a file, such as ArrivalTime.asc")
    configs = [_config("file", overrides, path) for path in paths]
    check_bank(output, len(paths), configs[0].env.grid)
    fires, names, sources = [], [], []
    for path, config in zip(map(Path, paths), configs, strict=True):
        read, about = _read(config)
        _print(console, f"{path.name}: read: {about}")
        fires.append(read)
        names += [f"{path.name}{f', fire {n}' if len(read) > 1 else ''}" for n in range(len(read))]
        sources.append({"file": path.name, "sha256": to_values(config)["fire"]["sha256"]})
    facts: dict[str, Any] = _facts(configs[0]) | {"sources": sources}
    del facts["fire"]["path"], facts["fire"]["sha256"]  # they hold for the first file only
    _write(output, torch.cat(fires), facts, names, console)
    return 0


def _divided(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Returns sources and `key=value`; an existing file takes precedence over a key."""
    keys = [text for text in arguments if "=" in text and not os.path.exists(text)]
    return [str(user_path(text)) for text in arguments if text not in keys], keys


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
    sides = " x ".join(map(_short, (world.num_uavs, width, world.displacement)))
    ratio = f": {_short(uncovered / most)} times as many" if most > 0 else ""
    quick, enough = most <= uncovered, steps <= world.horizon
    return [
        f"burning at the start  {burning[0]} cells",
        f"burning at the end    {end} cells",
        f"growth, mean          {_short(mean)} cells/step",
        f"growth, maximum       {_short(most)} cells/step, steps {since} to {since + window}",
        f"a UAV flies           {_short(world.displacement)} cells/step",
        f"a UAV sees            {_short(width)} cells across, from full altitude",
        f"the team uncovers     {_short(uncovered)} cells/step at most: {sides}",
        f"UAVs can keep up: {'yes' if quick and enough else 'no'}",
        f"  {'-+'[quick]} the team can uncover {_short(uncovered)} cells/step, "
        f"{_short(most)} start to burn{ratio}",
        f"  {'-+'[enough]} of {end} cells at the end {_short(in_view)} can be in view at once; "
        f"uncovering others takes at least {steps} of {world.horizon} steps",
    ]


def _short(value: float) -> str:
    """Returns a number with three digits, or all digits of a larger whole number."""
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


def _config(fire: str, overrides: Sequence[str], path: str | None = None) -> RunConfig:
    """Returns the configuration with which a scenario's fires are made, or a file is read."""
    if fire != "file" and fire not in scenarios():
        raise UserError(f"fire {unknown(fire, scenarios())}")
    for text in overrides:
        if not text.startswith(("setup=", "env.", "fire.")) or text.startswith("fire.path="):
            raise UserError(f"{shown(text)!r}: a fire depends on keys of setup, env. and fire.")
    # The path bypasses the parser of overrides, in which some characters have a meaning.
    keys = {} if path is None else {"fire.path": path}
    return resolve("independent", [f"fire={fire}", *overrides], **keys)  # any method


def _read(config: RunConfig) -> tuple[Tensor, str]:
    assert isinstance(config.fire, FileFireConfig)
    return read_with_summary(config.fire, config.env.grid, config.env.horizon)


def _facts(config: RunConfig, burn_out: Tensor | None = None) -> dict[str, Any]:
    """Returns the settings on which the fires depend; warns of times that are not written."""
    if burn_out is not None or math.isfinite(getattr(config.fire, "burn_time", math.inf)):
        warnings.warn(
            "a file of fires holds arrival times only, without the times at which cells burn out; "
            "fire.burn_time=STEPS gives one for all cells when the file is read",
            stacklevel=3,
        )
    about = {"horizon": config.env.horizon, "grid": list(config.env.grid)}
    return {**about, "fire": to_values(config)["fire"], "emberlink_version": version("emberlink")}


def _write(
    path: Path, fires: Tensor, facts: dict[str, Any], names: Sequence[str], console: Console
) -> None:
    write_bank(path, fires, facts=facts, names=names)
    cells, word = " x ".join(map(str, fires.shape[1:])), "fire" if len(fires) == 1 else "fires"
    _print(console, f"{len(fires)} {word} of {cells} cells, {facts['horizon']} steps", str(path))
