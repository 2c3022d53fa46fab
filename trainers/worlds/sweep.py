"""Runs `emberlink world sweep`: what messages are worth in many worlds."""

from collections.abc import Iterator, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from emberlink.trainers.config.compose import to_values
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.evaluation.baseline_cache import source_digest
from emberlink.trainers.worlds.axes import Axes, World, base_config, derived
from emberlink.trainers.worlds.play import ALL, ALONE, IN_RANGE, RANDOM, play_validation
from emberlink.trainers.worlds.plot import sweep_figure
from emberlink.trainers.worlds.sweep_folder import FIGURE, Line, SweepFolder
from emberlink.trainers.worlds.variants import NO_LIMITS, NO_RADIO, RangedMapGreedy, play_ranges
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
    worlds = list(axes.worlds())
    for world in worlds:
        derived(base, world)  # an error before the first world is played
    with SweepFolder(folder, _settings(base, axes, fires)) as record:
        console.print(f"{len(worlds)} worlds, of which {len(record.lines)} are done")
        for place, of_place in groupby(worlds, key=lambda world: world._replace(range=0.0)):
            here = list(of_place)  # played together, so that a resumed sweep has the same batches
            if all(world in record.lines for world in here):
                continue
            for world, line in _lines(derived(base, place), here, fires):
                if world not in record.lines:
                    record.append(world, line)
                    console.print(_text(len(record.lines), len(worlds), line), soft_wrap=True)
        lines = [record.lines[world] for world in worlds]
        headline = base.evaluation.headline
        for text in summary(lines, headline):
            console.print(text, soft_wrap=True)
        title = f"{headline} in {len(lines)} worlds made from {base.world}, {fires} fires each"
        with record.figure() as path:
            sweep_figure(path, lines, axes, headline, title)
        console.print(str(folder / FIGURE), soft_wrap=True)
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
        "sources": source_digest(RangedMapGreedy),
        **{key: values[key] for key in ("env", "fire", "comm")},
    }


def _lines(config: RunConfig, worlds: Sequence[World], fires: int) -> Iterator[tuple[World, Line]]:
    """Plays the policies in worlds that differ in the range only, and yields their lines.

    A line has the means of the policies, and the gains in the headline with standard errors.
    """
    headline = config.evaluation.headline
    at_random = play_validation(config, RANDOM, fires)
    none, *some, full = play_ranges(
        config, [NO_RADIO, *(world.range for world in worlds), NO_LIMITS], fires
    )
    for world, in_range in zip(worlds, some, strict=True):
        results = at_random, none, in_range, full
        line: Line = {
            **world._asdict(),
            "headline": [_mean(measured[headline]) for measured in results],
            "gain": _gain(none[headline], in_range[headline]),
            "gain_all": _gain(none[headline], full[headline]),
        }
        if "front_age" in none:
            line["front_age"] = [_mean(measured["front_age"]) for measured in results]
        yield world, line


def _mean(values: Sequence[float]) -> float:
    return round(float(np.mean(values)), 3)


def _gain(before: Sequence[float], after: Sequence[float]) -> list[float]:
    """Returns the mean over fires of the difference, and its standard error."""
    gains = np.subtract(after, before)
    error = gains.std(ddof=1) / len(gains) ** 0.5
    return [round(float(gains.mean()), 3), round(float(error), 3)]


def _text(done: int, total: int, line: Line) -> str:
    """Returns a line about a finished world."""
    (gain, error), (most, _) = line["gain"], line["gain_all"]
    return (
        f"  {done}/{total}: speed {line['speed']:g}, grid {line['grid']}, {line['uavs']} UAVs, "
        f"range {line['range']:g}: {gain:+.1f} ± {error:.1f} points, all messages {most:+.1f}"
    )
