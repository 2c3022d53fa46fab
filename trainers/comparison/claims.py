"""Tests the claims of the paper (sections V and VI) with intervals over seeds and fires."""

from itertools import product
from typing import Any

import pandas as pd

from emberlink.envs import metrics
from emberlink.trainers.comparison import bootstrap
from emberlink.trainers.comparison.bootstrap import Interval
from emberlink.trainers.comparison.tables import (
    Frame,
    by_fire,
    learned,
    telling_apart,
    trained_settings,
)

ROUNDING = 1e-6
"""relative error of a ratio of measures, which are float32"""
_COMMUNICATION = ("method", "replay", "comm.", "env.radio.")
"""beginnings of keys in which compared methods may differ"""
COLUMNS = (
    *("section", "fires", "label", "claim", "measure", "factor", "best_other", "ratio", "low"),
    *("high", "verdict", "fewest_seeds"),
)
"""columns of `verdicts`: `ratio` of the interquartile means, above 1 if the method is better;
infinite for a ratio to 0"""
METHOD = "consensus"
CLAIMS = (
    ("coverage", 1.3, "1.3 times the coverage"),
    ("tracking_first", 1.4, "1.4 times faster tracking"),
    ("tracking_last", 1.4, "1.4 times faster tracking, by the slowest UAV"),
    ("boundary_exits", 2.0, "half the boundary exits"),
)
"""claims of the paper about method 4: by which factor a measure is better than with others"""


def verdicts(runs: Frame, means: Frame) -> tuple[Frame, list[str]]:
    """Returns the verdict of each claim, set of fires and label of consensus, and notes.

    If consensus was trained in several ways, a label is compared with those labels of other methods
    that have the same settings in the keys that tell these ways apart. Communication may differ.
    """
    rows: list[dict[str, Any]] = []
    notes: list[str] = []
    settings = trained_settings(runs)
    is_own = settings["method"] == METHOD
    settings = settings[[key for key in settings if not key.startswith(_COMMUNICATION)]]
    own, others = settings[is_own], settings[~is_own]
    keys = telling_apart(own)
    for label in own.index if len(others) else ():
        alike = others.index[(others[keys] == own.loc[label, keys]).all(axis=1)]
        if alike.empty:
            notes.append(f"{label}: no claims; no other method was trained with its settings")
            continue
        part = learned(means)[learned(means)["label"].isin([label, *alike])]
        for fires, (measure, factor, text) in product(sorted(means["fires"].unique()), CLAIMS):
            about = {"section": runs["section"].iloc[0], "fires": fires, "label": label}
            about |= {"claim": text, "measure": measure, "factor": factor}
            of_measure = part[(part["fires"] == fires) & (part["measure"] == measure)]
            rows.append(about | _verdict(of_measure, label, measure, factor))
    return pd.DataFrame(rows, columns=list(COLUMNS)), notes


def _verdict(means: Frame, label: str, measure: str, factor: float) -> dict[str, Any]:
    """Returns the verdict about a label, given the means of it and of the others."""
    values = {name: by_fire(part) for name, part in means.groupby("label")}
    samples = [values.pop(label), *values.values()]
    higher = measure in metrics.HIGHER_IS_BETTER
    ratio, ends = bootstrap.ratio_to_best(*samples, higher=higher)
    iqms = [float(bootstrap.iqm(sample.mean(1))) for sample in samples[1:]]
    low, high = ends or (None, None)
    return {
        "best_other": [*values][iqms.index(max(iqms) if higher else min(iqms))],
        "ratio": ratio,
        "low": low,
        "high": high,
        "verdict": decision(ends, factor),
        "fewest_seeds": min(map(len, samples)),
    }


def decision(interval: Interval | None, factor: float) -> str:
    """Returns the verdict of an interval; an end `ROUNDING` below the factor is at the factor."""
    low, high = interval or (0.0, float("inf"))
    least = factor * (1 - ROUNDING)
    return "holds" if low >= least else "does not hold" if high < least else "undecided"
