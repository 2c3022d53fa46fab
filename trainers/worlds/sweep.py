"""Runs `emberlink world sweep`: what messages are worth in many worlds."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from emberlink.policies.scripted.registry import SCRIPTED
from emberlink.trainers.config.compose import to_values
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.evaluation.baseline_cache import source_digest
from emberlink.trainers.worlds.axes import Axes, World, base_config, derived
from emberlink.trainers.worlds.play import ALL, ALONE, IN_RANGE, RANDOM, played
from emberlink.trainers.worlds.plot import sweep_figure
from emberlink.trainers.worlds.sweep_folder import Line, SweepFolder
from emberlink.trainers.worlds.worth import summary

POLICIES = (RANDOM, ALONE, IN_RANGE, ALL)


def sweep(
    folder: Path, overrides: Sequence[str], console: Console, *, axes: Axes, fires: int
) -> int:
    """Plays scripted policies in the worlds that are not in the folder yet, and draws the figure.

    Args:
        folder: a new folder, or that of a sweep with the same settings.
        overrides: `key=value` of the base world.
        console: prints a line per world, then a summary and the path of the figure.
        axes: the values of the sweep.
        fires: number of validation fires per world.

    Raises:
        UserError: a value is wrong, or the folder is of another sweep or cannot be written.
    """
    base = base_config(overrides)
    worlds = {world: derived(base, world) for world in axes.worlds()}
    with SweepFolder(folder, _settings(base, axes, fires)) as record:
        left = [world for world in worlds if world not in record.lines]
        console.print(f"{len(worlds)} worlds, of which {len(worlds) - len(left)} are done")
        for world in left:
            line = _line(world, worlds[world], derived(base, _reference(base, world)), fires)
            record.append(world, line)
            console.print(_text(len(record.lines), len(worlds), line), soft_wrap=True)
        lines = [record.lines[world] for world in worlds]
        headline = base.evaluation.headline
        for text in summary(lines, headline):
            console.print(text, soft_wrap=True)
        title = f"{headline} in {len(lines)} worlds made from {base.world}, {fires} fires each"
        figure = record.write_figure(sweep_figure(lines, axes, headline, title))
        console.print(str(figure), soft_wrap=True)
    return 0


def _settings(base: RunConfig, axes: Axes, fires: int) -> dict[str, Any]:
    """Returns all that the lines of a sweep depend on, as plain values."""
    values = to_values(base)
    return {
        "world": base.world,
        "speeds": list(axes.speeds),
        "grids": list(axes.grids),
        "teams": list(axes.teams),
        "ranges": list(axes.ranges),
        "validation_fires": fires,
        "headline": base.evaluation.headline,
        "policies": list(POLICIES),
        "sources": source_digest(*(SCRIPTED[name] for name in POLICIES)),
        **{key: values[key] for key in ("env", "fire", "comm")},
    }


def _reference(base: RunConfig, world: World) -> World:
    """Returns the world in which policies that do not use the radio are played.

    The range is that of the base world, so that they are played once for all ranges. With a base
    station their measures depend on the range.
    """
    return world if base.env.base is not None else world._replace(range=base.env.radio.range)


def _line(world: World, config: RunConfig, reference: RunConfig, fires: int) -> Line:
    """Returns the line of a world: means of the policies, and gains with their standard errors."""
    results = {
        name: played(
            config if name == IN_RANGE else reference, name, fires=fires, split="validation"
        )
        for name in POLICIES
    }
    headline = config.evaluation.headline
    none, some, full = (np.asarray(results[name][headline]) for name in (ALONE, IN_RANGE, ALL))
    line: Line = {
        **world._asdict(),
        "headline": [_mean(results[name][headline]) for name in POLICIES],
        "gain": _gain(none, some),
        "gain_all": _gain(none, full),
    }
    if "front_age" in results[ALONE]:
        line["front_age"] = [_mean(results[name]["front_age"]) for name in POLICIES]
    return line


def _mean(values: Sequence[float]) -> float:
    return round(float(np.mean(values)), 3)


def _gain(before: np.ndarray, after: np.ndarray) -> list[float]:
    """Returns the mean over fires of the difference, and its standard error."""
    gains = after - before
    error = gains.std(ddof=1) / len(gains) ** 0.5
    return [round(float(gains.mean()), 3), round(float(error), 3)]


def _text(done: int, total: int, line: Line) -> str:
    """Returns a line about a finished world."""
    (gain, error), (most, _) = line["gain"], line["gain_all"]
    return (
        f"  {done}/{total}: speed {line['speed']:g}, grid {line['grid']}, {line['uavs']} UAVs, "
        f"range {line['range']:g}: {gain:+.1f} ± {error:.1f} points, all messages {most:+.1f}"
    )
