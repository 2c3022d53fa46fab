"""What `emberlink fire preview` does: a picture of a fire, and whether UAVs can keep up with it."""

import os
import re
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path

from rich import box
from rich.console import Console
from rich.table import Table

from emberlink.envs.utils.publish import free_name, new_file, published

from .plot import arrival_figure
from .select import Source, find
from .stats import Growth, Team, comparisons, growth, short


def preview(
    source: str, overrides: Sequence[str], console: Console, output: Path | None = None
) -> int:
    """Draws a fire and prints its numbers.

    Args:
        source: a scenario, SCENARIO:INDEX, a file, or FILE:INDEX.
        overrides: `key=value` of setup, env. and fire.
        console: told the numbers and, last, where the picture is.
        output: a folder, or a new .png file; the working directory if None.

    Raises:
        ValueError: one line for whatever cannot be found, read, drawn or written.
    """
    path = new_file(output, [".png"]) if output is not None and not os.path.isdir(output) else None
    fire = find(source, overrides)
    world, arrival = fire.config.env, fire.arrival.numpy()
    team, numbers = Team.of(world), growth(arrival, world.horizon)
    if path is None:
        stem = re.sub(r"[^\w.+-]", "-", fire.stem)[:100]
        name = free_name(output or Path(), stem, [".png"])
        path = name.with_name(f"{name.name}.png")
    with published(path) as partial, warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph")  # a file's name may be in any script
        arrival_figure(partial, arrival, world.horizon, team, fire.title)
    _print(console, fire, numbers, team)
    console.print(str(path), soft_wrap=True, highlight=False)
    return 0


def _print(console: Console, fire: Source, numbers: Growth, team: Team) -> None:
    horizon = fire.config.env.horizon
    grid = " x ".join(map(str, fire.config.env.grid))
    console.print(
        f"{fire.title}: {grid} cells, {horizon} steps, setup {fire.config.setup}",
        soft_wrap=True,
        highlight=False,
    )
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


def _rows(fire: Growth, team: Team) -> Iterator[tuple[str, str, str]]:
    """What is measured, the number, and its unit and meaning."""
    until = fire.since + fire.window
    yield "burning at the start", str(fire.start), "cells"
    yield "burning at the end", str(fire.end), "cells"
    yield "growth, mean", short(fire.mean), "cells/step"
    yield "growth, most", short(fire.most), f"cells/step, steps {fire.since} to {until}"
    yield "front, fastest", short(fire.speed), f"cells/step, over {fire.window} steps"
    yield "a UAV flies", short(team.flight), "cells/step"
    yield "a UAV sees", short(team.width), "cells across, from full altitude"
    product = " x ".join(map(short, (team.uavs, team.width, team.flight)))
    yield "the team sweeps", short(team.sweep), f"cells/step at most: {product}"
