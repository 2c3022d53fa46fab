"""Runs `emberlink fire make` and `emberlink fire import`, which write fires to a file."""

import math
import os
import re
import warnings
from collections.abc import Iterator, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.progress import track
from torch import Tensor

from emberlink.envs.config import WildfireConfig
from emberlink.envs.fire.cache import GENERATOR_VERSION
from emberlink.envs.fire.generator import GeneratedConfig, Split, fire_seeds, make_fires
from emberlink.envs.scenarios import ScenarioConfig
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.publish import free_name
from emberlink.envs.world.burning import split_times
from emberlink.trainers.config.compose import to_values
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.fires.bank_writer import check_bank, write_bank
from emberlink.trainers.fires.select import from_file, generated, read

_AT_A_TIME = 16  # fires between two updates of the progress bar


def make(
    scenario: str,
    overrides: Sequence[str],
    console: Console,
    *,
    count: int | None = None,
    split: Split = "train",
    output: Path | None = None,
) -> int:
    """Makes fires of a scenario and writes them to a file.

    Args:
        scenario: a file in configs/fire.
        overrides: `key=value` of setup, env. and fire.
        console: prints the progress and, last, the path of the file.
        count: number of fires; as many as a training or an evaluation uses if None.
        split: "train", "validation" or "test".
        output: a new .npy, .tif or .tiff file; the next free name if None.

    Raises:
        UserError: a name is not known, or the file cannot be written.
    """
    config = generated(scenario, overrides)
    assert isinstance(config.fire, GeneratedConfig)
    count = count or _usual_count(config, config.fire)[split]
    path = output or _free(f"{scenario}_{split}_{count}")
    check_bank(path, count, config.env.grid)
    seeds = fire_seeds(split, count)
    facts = {
        "scenario": scenario,
        "split": split,
        "seeds": f"{seeds[0]} to {seeds[-1]}",
        **_facts(config),
        "generator_version": GENERATOR_VERSION,
    }
    names = [f"{scenario} {split} {seed}" for seed in seeds.tolist()]
    _write(path, _make(config.fire, seeds, config.env, console), facts, names, console)
    return 0


def _usual_count(config: RunConfig, fire: GeneratedConfig) -> dict[Split, int]:
    """Returns the number of fires that a training or an evaluation uses."""
    evaluation = config.evaluation
    return {
        "train": fire.num_train_fires,
        "validation": evaluation.interval_episodes,
        "test": evaluation.episodes,
    }


def _make(fire: GeneratedConfig, seeds: Tensor, world: WildfireConfig, console: Console) -> Tensor:
    """Makes the fires of seeds and prints the progress."""
    parts = track(
        seeds.split(_AT_A_TIME),
        "making fires",
        console=console,
        transient=True,
        disable=not console.is_terminal,
    )
    made = torch.cat([make_fires(fire, part, world.grid, world.horizon) for part in parts])
    arrival, burn_out = split_times(made)
    _warn_of_burn_out(fire, burn_out)
    return arrival


def _warn_of_burn_out(fire: ScenarioConfig, burn_out: Tensor | None) -> None:
    """Warns that a file of fires will not hold the times at which cells burn out, if they do."""
    if burn_out is not None or math.isfinite(getattr(fire, "burn_time", math.inf)):
        warnings.warn(
            "a file of fires holds arrival times only, without the times at which cells burn out; "
            "fire.burn_time=STEPS gives one for all cells when the file is read",
            stacklevel=3,
        )


def import_files(arguments: Sequence[str], console: Console, output: Path) -> int:
    """Reads files of fires and writes them to one.

    Args:
        arguments: paths, and `key=value` of setup, env. and fire.
        console: prints the number of fires and, last, the path of the file.
        output: a new .npy, .tif or .tiff file.

    Raises:
        UserError: a file cannot be read or written.
    """
    # An existing file takes precedence over a key.
    overrides = [text for text in arguments if "=" in text and not os.path.exists(text)]
    paths = [Path(text) for text in arguments if text not in overrides]
    if not paths:
        raise UserError("FILE is missing; expected a file, such as ArrivalTime.asc")
    configs = [from_file(path, overrides) for path in paths]
    check_bank(output, len(paths), configs[0].env.grid)
    fires, names = [], []
    for path, config in zip(paths, configs, strict=True):
        fires.append(read(config)[0])
        names += list(_names(path, len(fires[-1])))
    _warn_of_burn_out(configs[0].fire, None)
    facts = _facts(configs[0])
    del facts["fire"]["path"], facts["fire"]["sha256"]  # they hold for the first file only
    digests = [to_values(config)["fire"]["sha256"] for config in configs]
    facts["sources"] = [
        {"file": path.name, "sha256": digest} for path, digest in zip(paths, digests, strict=True)
    ]
    _write(output, torch.cat(fires), facts, names, console)
    return 0


def _names(path: Path, count: int) -> Iterator[str]:
    for number in range(count):
        yield path.name if count == 1 else f"{path.name}, fire {number}"


def _facts(config: RunConfig) -> dict[str, Any]:
    """Returns the settings on which the fires depend."""
    return {
        "horizon": config.env.horizon,
        "grid": list(config.env.grid),
        "fire": to_values(config)["fire"],
        "emberlink_version": version("emberlink"),
    }


def _free(stem: str) -> Path:
    name = free_name(Path(), re.sub(r"[^\w.+-]", "-", stem), [".npy", ".json"])
    return name.with_name(f"{name.name}.npy")


def _write(
    path: Path, fires: Tensor, facts: dict[str, Any], names: Sequence[str], console: Console
) -> None:
    write_bank(path, fires, facts=facts, names=names)
    cells = " x ".join(map(str, fires.shape[1:]))
    word = "fire" if len(fires) == 1 else "fires"
    console.print(
        f"{len(fires)} {word} of {cells} cells, {facts['horizon']} steps", highlight=False
    )
    console.print(str(path), soft_wrap=True, highlight=False)
