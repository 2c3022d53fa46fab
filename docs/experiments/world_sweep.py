"""Measures what messages are worth in many worlds: docs/data/world_sweep.jsonl and its figure.

    python docs/experiments/world_sweep.py worlds.jsonl worlds.png [key=value ...]

In each world, random waypoints and `map_greedy` without messages, with the radio and with all
messages play on eight validation fires; the first file gets a line for each. Worlds that are in the
file are not played again. The 500 worlds take about an hour of one core.
"""

import json
import sys
from functools import cache
from itertools import product
from pathlib import Path

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import TwoSlopeNorm
from matplotlib.figure import Figure

from emberlink.trainers.config.compose import override
from emberlink.trainers.worlds.check import played, world_config

SPEEDS, GRIDS = (0.5, 0.75, 1.0, 1.5, 2.0), (30, 45, 60, 75)
TEAMS, RANGES = (2, 4, 6, 8, 12), (5.0, 10.0, 15.0, 20.0, 40.0)
FIRES = 8
POLICIES = ("random_waypoints", "map_greedy_alone", "map_greedy", "map_greedy_all")
base = world_config(["world=front", *sys.argv[3:]])
headline = base.evaluation.headline


@cache
def measured(policy: str, speed: float, grid: int, uavs: int, reach: float = 10.0) -> dict:
    """Plays a policy; only `map_greedy` depends on the range of the radio."""
    low, high = (rate * speed for rate in base.fire.head_ros)
    keys = [f"fire.head_ros=[{low},{high}]", f"env.grid=[{grid},{grid}]"]
    config = override(base, [*keys, f"env.num_uavs={uavs}", f"env.radio.range={reach}"])
    return played(config, policy, fires=FIRES, split="validation")


def line(speed: float, grid: int, uavs: int, reach: float) -> dict:
    """Returns the row of a world; gains are means over fires with their standard errors."""
    place = speed, grid, uavs
    results = [
        measured(name, *place, *([reach] if name == "map_greedy" else [])) for name in POLICIES
    ]
    _, none, some, every = (np.array(result[headline]) for result in results)
    gains = [[g.mean(), g.std(ddof=1) / FIRES**0.5] for g in (some - none, every - none)]
    means = {
        name: [np.mean(result[name]) for result in results] for name in (headline, "front_age")
    }
    world = {"speed": speed, "grid": grid, "uavs": uavs, "range": reach}
    numbers = {"headline": means[headline], "gain": gains[0], "gain_all": gains[1]}
    numbers["front_age"] = means["front_age"]
    return world | {key: np.round(value, 3).tolist() for key, value in numbers.items()}


def draw(rows: dict, path: str) -> None:
    """Draws a panel per grid and speed, and marks gains of more than two standard errors."""
    scale = ScalarMappable(TwoSlopeNorm(0, -30, 30), "RdBu")
    figure = Figure(figsize=(10.5, 7), layout="constrained")
    panels = figure.subplots(len(GRIDS), len(SPEEDS), sharex=True, sharey=True)
    for (grid, speed), panel in zip(product(GRIDS, SPEEDS), panels.flat, strict=True):
        panel.set_title(f"{grid} x {grid} cells, speed {speed:g}", fontsize=8)
        colours = np.ones((len(TEAMS), len(RANGES) + 2, 4))
        for y, uavs in enumerate(TEAMS):
            here = [rows[speed, grid, uavs, reach] for reach in RANGES]
            panel.text(0, y, f"{here[0]['headline'][1]:.0f}", ha="center", va="center", fontsize=8)
            for x, (gain, error) in enumerate([*(r["gain"] for r in here), here[0]["gain_all"]], 1):
                clear, nothing = abs(gain) > 2 * error, abs(gain) + 2 * error <= 2
                colours[y, x] = scale.to_rgba(gain) if clear else (0.93, 0.93, 0.93, 1)
                text = f"{gain:.0f}" if clear else "0" if nothing else ""
                panel.text(x, y, text, ha="center", va="center", fontsize=8)
        panel.imshow(colours)
        panel.set_xticks(range(len(RANGES) + 2), ["none", *map("{:g}".format, RANGES), "all"])
        panel.set_yticks(range(len(TEAMS)), TEAMS)
        panel.tick_params(length=0, labelsize=8)
    figure.supxlabel("messages: none (the measure), radio range in cells, all")
    figure.supylabel("UAVs")
    figure.colorbar(scale, ax=panels, aspect=40, label=f"{headline} gained by messages, points")
    figure.savefig(path, dpi=160)


file = Path(sys.argv[1])
known = map(json.loads, file.read_text().splitlines() if file.exists() else [])
rows = {(row["speed"], row["grid"], row["uavs"], row["range"]): row for row in known}
for world in product(SPEEDS, GRIDS, TEAMS, RANGES):
    if world not in rows:
        rows[world] = line(*world)
        with file.open("a") as lines:
            lines.write(json.dumps(rows[world]) + "\n")
gains = [row["gain"] for row in rows.values()]
print(f"{len(gains)} worlds; the radio brings a clear gain in", end=" ")
print(sum(gain > 2 * error for gain, error in gains), end=", a clear loss in ")
print(sum(gain < -2 * error for gain, error in gains))
draw(rows, sys.argv[2])
