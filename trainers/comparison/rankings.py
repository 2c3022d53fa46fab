"""Computes the rankings by measure, the results of scripted policies and the training curves."""

from itertools import zip_longest
from typing import Any

import numpy as np
import pandas as pd

from emberlink.envs import metrics
from emberlink.trainers.comparison import bootstrap
from emberlink.trainers.comparison.bootstrap import Values
from emberlink.trainers.comparison.tables import (
    Frame,
    by_fire,
    learned,
    settings_table,
    trained_settings,
)
from emberlink.trainers.evaluation.scores import CURVES, LEARNED

REWARD = "mean_reward"
"""the measure that depends on a method's own reward"""
_PLACES = 3
"""decimal places in which a scripted policy may differ between devices"""
RANKING = (
    *("section", "fires", "measure", "label", "policy", "seeds", "values", "iqm", "low", "high"),
    *("next", "probability", "probability_low", "probability_high", "not_ranked"),
)
"""columns of `rank`: `values` are the runs' means, `iqm` their interquartile mean with the ends of
its interval, `probability` that a run is better than a run of the label in `next`"""


def trained_on(runs: Frame) -> str:
    """Returns the evaluated set of fires that a section was trained on; empty if there is none."""
    first = runs.iloc[0]
    names = f"{first['trained_on']}_as_trained", first["trained_on"]
    return next((name for name in names if name in first["object"].evaluation.results), "")


def rank(runs: Frame, means: Frame) -> Frame:
    """Returns the rankings of a section: by set of fires, measure and rank.

    The fires trained on and the world's headline are first; the reward is last, since methods may
    have different ones. Scripted policies, without seeds, have the mean over fires as `iqm`.
    """
    count = learned(means)["measure"].value_counts()
    everywhere = len(learned(means).drop_duplicates(["run", "evaluated_with", "fires"]))
    known = [name for name in metrics.ALL if count.get(name) == everywhere]
    known.sort(key=lambda name: (name == REWARD, name != runs["object"].iloc[0].headline))
    first = trained_on(runs)
    rows: list[dict[str, Any]] = []
    for fires in sorted(means["fires"].unique(), key=lambda name: (name != first, name)):
        on_fires = means[means["fires"] == fires]
        for measure in known:
            about = {"section": runs["section"].iloc[0], "fires": fires, "measure": measure}
            why = different_rewards(runs) if measure == REWARD else ""
            part = learned(on_fires[on_fires["measure"] == measure])
            ranked = _rows(part, measure in metrics.HIGHER_IS_BETTER, bool(why))
            found = [*ranked, *_scripted(on_fires, measure)]
            rows += [{**about, "not_ranked": why, **row} for row in found]
    return pd.DataFrame(rows, columns=list(RANKING))


def _rows(means: Frame, higher: bool, unranked: bool) -> list[dict[str, Any]]:
    """Returns the rows of the trained policies of one measure, best first."""
    groups: dict[Any, Frame] = dict(iter(means.groupby("label")))
    values = {label: by_fire(part) for label, part in groups.items()}
    iqms = {label: float(bootstrap.iqm(sample.mean(1))) for label, sample in values.items()}
    order = list(groups)
    if not unranked:
        order.sort(key=lambda label: -iqms[label] if higher else iqms[label])
    rows: list[dict[str, Any]] = []
    for label, other in zip_longest(order, [] if unranked else order[1:]):
        low, high = bootstrap.crossed_interval(bootstrap.iqm, values[label]) or (None, None)
        row: dict[str, Any] = {"label": label, "policy": LEARNED, "next": other or ""}
        row |= {"seeds": groups[label]["seed"].tolist(), "values": values[label].mean(1).tolist()}
        row |= {"iqm": iqms[label], "low": low, "high": high}
        if other and groups[label]["run"].isin(groups[other]["run"]).sum() == 0:
            pair = (values[label], values[other])[:: 1 if higher else -1]
            if ends := bootstrap.crossed_interval(bootstrap.probability_of_improvement, *pair):
                now = bootstrap.probability_of_improvement(*(sample.mean(1) for sample in pair))
                row["probability"] = float(now)
                row["probability_low"], row["probability_high"] = ends
        rows.append(row)
    return rows


def _scripted(means: Frame, measure: str) -> list[dict[str, Any]]:
    """Returns the rows of the scripted policies: one each, or several if labels have other values.

    A policy that heeds messages depends on the communication of the runs it was played for.
    """
    played = means[(means["policy"] != LEARNED) & (means["measure"] == measure)]
    rows: list[dict[str, Any]] = []
    for policy, part in played.groupby("policy"):
        of_labels = part.groupby("label")["value"].first()
        groups = [group for _, group in of_labels.groupby(of_labels.round(_PLACES))]
        for group in groups:
            name = str(policy).replace("_", " ")
            name += f" ({', '.join(group.index)})" if len(groups) > 1 else ""
            rows.append({"label": name, "policy": policy, "seeds": [], "iqm": group.iloc[0]})
    return rows


def different_rewards(runs: Frame) -> str:
    """Returns why the rewards of a section cannot be compared; an empty text if they can."""
    settings = settings_table(runs["settings"]).filter(regex=r"^env\.reward\.")
    keys = settings.columns[settings.nunique() > 1]
    return f"the methods' rewards differ in {', '.join(keys)}" if len(keys) else ""


def differing(runs: Frame) -> Frame:
    """Returns the settings in which the labels of a section differ, besides communication."""
    settings = trained_settings(runs)
    settings = settings.loc[:, settings.nunique() > 1]
    return settings[[key for key in settings if not key.startswith(("method", "comm.", "replay"))]]


def curves(runs: Frame) -> Frame:
    """Returns the interquartile mean over seeds, `iqm`, of each training episode of a section."""
    columns = ["section", "label", "measure", "episode", "iqm", "low", "high"]
    parts: list[Frame] = [pd.DataFrame(columns=columns)]
    trained = runs[runs["as_trained"] & runs["object"].map(lambda run: len(run.lines) > 0)]
    for label, group in trained.groupby("label"):
        for measure in CURVES:
            values = np.array([[line[measure] for line in r.lines] for r in group["object"]], float)
            about = {"section": group["section"].iloc[0], "label": label, "measure": measure}
            parts.append(band(values, np.arange(1, values.shape[1] + 1), **about))
    return pd.concat(parts[1:] or parts, ignore_index=True)


def band(values: Values, episodes: Any, **about: Any) -> Frame:
    """Returns the interquartile mean of curves, [seeds, episodes], and the ends of its interval."""
    low, high = bootstrap.curve_interval(values) or (np.nan, np.nan)
    middle = bootstrap.iqm(values, axis=0)
    return pd.DataFrame({**about, "episode": episodes, "iqm": middle, "low": low, "high": high})
