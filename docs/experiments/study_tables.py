"""Prints the tables of the study (docs/study.md) from its runs.

python docs/experiments/study_tables.py OUTPUT
"""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from study import WORLDS, arms

from emberlink.trainers.comparison import bootstrap
from emberlink.trainers.comparison.comparison import Comparison, compare_runs

PLANNED = [
    ("front", "vector_attention", "vector_none"),
    ("front", "vector_consensus", "vector_none"),
    ("front", "map_attention", "map_none"),
    ("front", "map_consensus", "map_none"),
    ("front", "map_maps", "map_none"),
    ("front", "map_attention", "map_maps"),
    ("front", "map_attention_16", "map_maps_16"),
    ("front", "map_attention_64", "map_maps_64"),
    ("relay", "vector_attention", "vector_none"),
    ("relay", "map_attention", "map_none"),
    ("relay", "map_maps", "map_none"),
    ("paper", "vector_attention", "vector_none"),
    ("paper", "map_maps", "map_none"),
    ("swarm", "map_maps", "map_none"),
]
"""the comparisons: world, and the two arms"""
UNLIMITED = "map_none", "map_maps", "map_maps_unlimited"
"""arms without radio, with that of the world, and with one without limits"""


def main(output: str) -> None:
    """Prints the arms of each world, the comparisons and the value of communication."""
    compared: dict[str, Comparison] = {}
    for world in WORLDS:
        folders = [Path(output) / world / "_".join(arm) for arm in arms(world)]
        folders = [folder for folder in folders if [*folder.glob("*/eval.json")]]
        if folders:
            compared[world] = compare_runs(folders, [folder.name for folder in folders])
            print_arms(world, compared[world])
    pairs = {}
    for world, one, other in PLANNED:
        if world in compared and {one, other} <= set(compared[world].runs["label"]):
            difference = compared[world].difference(one, other, headline(compared[world]))
            pairs[world, f"{one} - {other}"] = difference
    # Comparisons whose runs are not there yet count, too.
    ps = [1.0 if found.p is None else found.p for found in pairs.values()]
    corrected = bootstrap.holm(ps + [1.0] * (len(PLANNED) - len(ps)))
    _head("world", "comparison", "difference", "95 % interval", "p, Holm")
    for (names, found), p in zip(pairs.items(), corrected, strict=False):
        _row(*names, f"{found.value:.1f}", _ends(found.interval), f"{p:.4f}")
    _head("world", "arm", "value of communication")
    for world, runs in compared.items():
        if set(UNLIMITED) <= set(runs.runs["label"]):
            means = runs.means[runs.means["measure"] == headline(runs)]
            found = [means[means["label"] == arm]["values"].tolist() for arm in UNLIMITED]
            _row(world, UNLIMITED[1], value_of_communication(*map(np.array, found)))


def print_arms(world: str, compared: Comparison) -> None:
    """Prints a row for each arm and each of its evaluations, best first."""
    runs, ranking = compared.runs, compared.ranking
    measure = headline(compared)
    sent = ranking[ranking["measure"] == "bytes_per_step"].set_index("label")["iqm"]
    _head(f"{world}: {measure}", "seeds", "IQM", "95 % interval", "bytes", "rise")
    for row in ranking[ranking["measure"] == measure].to_dict("records"):
        of_arm = runs[runs["label"] == row["label"]]["object"]
        rise = np.mean([rise_at_the_end(run.lines, measure) for run in of_arm])
        numbers = f"{row['iqm']:.1f}", _ends((row["low"], row["high"])), f"{sent[row['label']]:.1f}"
        _row(row["label"], len(row["seeds"]), *numbers, f"{rise:.1f}")


def rise_at_the_end(lines: Sequence[Any], measure: str) -> float:
    """Returns by how much the validations of the last eighth exceed those of the one before."""
    shown = [v for line in lines for key, v in line.items() if key.endswith(f"/{measure}")]
    last = shown[-max(2, len(shown) // 4) :]
    half = len(last) // 2
    return float(np.mean(last[half:]) - np.mean(last[:half]))


def headline(compared: Comparison) -> str:
    """Returns the headline measure of the compared runs."""
    return compared.runs["object"].iloc[0].headline


def value_of_communication(none: Any, arm: Any, full: Any) -> str:
    """Returns (arm - none) / (full - none) with its interval, where full - none is above 0."""

    def share(none: Any, arm: Any, full: Any, axis: int = -1) -> Any:
        gains = [bootstrap.iqm_difference(sample, none, axis) for sample in (arm, full)]
        return gains[0] / gains[1]

    most = bootstrap.crossed_interval(bootstrap.iqm_difference, full, none)
    if most is None or most[0] <= 0:
        return "undetermined"
    value = share(*(sample.mean(1) for sample in (none, arm, full)))
    return f"{value:.2f} {_ends(bootstrap.crossed_interval(share, none, arm, full), 2)}"


def _ends(ends: Any, digits: int = 1) -> str:
    if ends is None or pd.isna([*ends]).any():
        return ""
    return f"[{ends[0]:.{digits}f}, {ends[1]:.{digits}f}]"


def _head(*names: str) -> None:
    print()
    _row(*names)
    _row(*("---" for _ in names))


def _row(*cells: Any) -> None:
    print("|", " | ".join(map(str, cells)), "|")


if __name__ == "__main__":
    main(*sys.argv[1:])
