"""Runs `emberlink fire preview`: draws a fire and tells whether UAVs can keep up with it."""

import os
import re
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path

from rich import box
from rich.console import Console
from rich.table import Table

from emberlink.envs.utils.publish import free_name, new_file, published
from emberlink.trainers.fires.plot import arrival_figure
from emberlink.trainers.fires.select import SelectedFire, find_fire
from emberlink.trainers.fires.stats import Growth, TeamCapability, comparisons, growth, short


def preview(
    source: str, overrides: Sequence[str], console: Console, output: Path | None = None
) -> int:
    """Draws a fire and prints its numbers.

    Args:
        source: a scenario, SCENARIO:INDEX, a file, or FILE:INDEX.
        overrides: `key=value` of setup, env. and fire.
        console: prints the numbers and, last, the path of the picture.
        output: a folder, or a new .png file; the working directory if None.

    Raises:
        UserError: the fire cannot be found, read, drawn or written.
    """
    path = new_file(output, [".png"]) if output is not None and not os.path.isdir(output) else None
    fire = find_fire(source, overrides)
    world, arrival = fire.config.env, fire.arrival.numpy()
    team, numbers = TeamCapability.of(world), growth(arrival, world.horizon)
    if path is None:
        stem = re.sub(r"[^\w.+-]", "-", fire.stem)[:100]
        name = free_name(output or Path(), stem, [".png"])
        path = name.with_name(f"{name.name}.png")
    with published(path) as partial, warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph")  # the font may lack letters of the file's name
        arrival_figure(partial, arrival, world.horizon, team, fire.title)
    _print(console, fire, numbers, team)
    console.print(str(path), soft_wrap=True, highlight=False)
    return 0


def _print(console: Console, fire: SelectedFire, numbers: Growth, team: TeamCapability) -> None:
    horizon = fire.config.env.horizon
    grid = " x ".join(map(str, fire.config.env.grid))
    console.print(
        f"{fire.title}: {grid} cells, {horizon} steps, setup {fire.config.setup}",
        soft_wrap=True,
        highlight=False,
    )
    if fire.summary:
        console.print(f"read: {fire.summary}", soft_wrap=True, highlight=False)
    table = Table(box=box.SIMPLE_HEAD, padding=0, show_edge=False, show_header=False)
    table.add_column()
    table.add_column(justify="right", no_wrap=True)
    table.add_column(overflow="fold")
    for row in _rows(numbers, team):
        table.add_row(*row)
    console.print(table, highlight=False)
    checks = comparisons(numbers, team, horizon)
    verdict = "yes" if all(enough for enough, _ in checks) else "no"
    console.print(f"UAVs can keep up: {verdict}", highlight=False, style="bold")
    for enough, text in checks:
        console.print(f"  {'+' if enough else '-'} {text}", soft_wrap=True, highlight=False)


def _rows(fire: Growth, team: TeamCapability) -> Iterator[tuple[str, str, str]]:
    """Yields the name, the number, and the unit of each measure."""
    until = fire.since + fire.window
    yield "burning at the start", str(fire.start), "cells"
    yield "burning at the end", str(fire.end), "cells"
    yield "growth, mean", short(fire.mean), "cells/step"
    yield "growth, maximum", short(fire.maximum), f"cells/step, steps {fire.since} to {until}"
    yield "a UAV flies", short(team.flight), "cells/step"
    yield "a UAV sees", short(team.width), "cells across, from full altitude"
    product = " x ".join(map(short, (team.num_uavs, team.width, team.flight)))
    yield "the team uncovers", short(team.uncovered), f"cells/step at most: {product}"
