"""Measures the environment's speed by grid, team and number of environments.

    python tests/benchmarks/scaling.py [FIGURE.png]

The axes that are not measured keep the paper's values, 30 x 30 cells and 6 UAVs, and 256
environments. Prints a Markdown table of UAV-steps per second.
"""

import sys

from workloads import flying, in_turns, make, steps_for

AXES = {
    "cells along a side": [30, 60, 120, 256],
    "UAVs": [6, 12, 24, 64],
    "environments": [1, 4, 16, 64, 256, 1024, 4096],
}
METHODS = {"environment alone": None, "with consensus": "consensus"}


def settings(axis: str, value: int) -> tuple[int, int, dict]:
    """Returns environments, UAVs, and the settings that differ from the paper."""
    envs, uavs, more = 256, 6, {}
    if axis == "environments":
        envs = value
    elif axis == "UAVs":
        uavs, more = value, {"num_uavs": value}
    else:
        more = {"grid": [value, value]}
    return envs, uavs, more


def measure(axis: str) -> dict[str, list[float]]:
    """Measures UAV-steps per second of both methods for every value on an axis, in turns."""
    rates: dict[str, list[float]] = {}
    for name, method in METHODS.items():
        works, sizes = [], []
        for value in AXES[axis]:
            envs, uavs, more = settings(axis, value)
            steps = max(3, steps_for(envs, uavs) // 4)
            works.append(flying(make(method, envs, **more), steps))
            sizes.append(envs * uavs * steps)
        taken = in_turns(7, *works)
        rates[name] = [size / seconds for size, seconds in zip(sizes, taken, strict=True)]
    return rates


def draw(results: dict[str, dict[str, list[float]]], file: str) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, panels = plt.subplots(1, 3, figsize=(11, 3.4), sharey=True, layout="constrained")
    for panel, (axis, rates) in zip(panels, results.items(), strict=True):
        for name, values in rates.items():
            panel.plot(AXES[axis], values, marker="o", label=name)
        panel.set(xscale="log", yscale="log", xlabel=axis)
        panel.set_xticks(AXES[axis], [f"{value:,}" for value in AXES[axis]], rotation=45)
        panel.minorticks_off()
        panel.grid(alpha=0.3)
    panels[0].set_ylabel("UAV-steps a second")
    panels[0].legend()
    figure.savefig(file, dpi=110)


def main(file: str | None) -> None:
    results = {axis: measure(axis) for axis in AXES}
    print(f"| | | {' | '.join(METHODS)} |\n|---|---|{'---|' * len(METHODS)}")
    for axis, rates in results.items():
        for at, value in enumerate(AXES[axis]):
            row = " | ".join(f"{values[at]:,.0f}" for values in rates.values())
            print(f"| {axis} | {value:,} | {row} |")
    if file:
        draw(results, file)


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else None)
