"""Puts runs into tables: one row per run, one per mean, one per fire and measure.

A *section* holds runs that can be compared: one setup, world and its edition, training fire,
horizon, grid and set of held-out fires. A *row* of a ranking is a label: trainings that differ in
the seed alone.
"""

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from emberlink.trainers.comparison.bootstrap import Values
from emberlink.trainers.comparison.reading import EvaluatedRun, LeftOut
from emberlink.trainers.config.schema import NOT_LEARNT_WITH
from emberlink.trainers.evaluation.scores import LEARNED
from emberlink.trainers.runs import pretrained
from emberlink.trainers.runs.run_folder import without_time_and_seed

NOT_COMPARED = ("seed", "output", "evaluation", *NOT_LEARNT_WITH)
"""first parts of keys that do not affect training"""
_RADIO = "range", "loss", "bandwidth", "burst", "delay", "fade", "shared"
RADIO = tuple(f"env.radio.{key}" for key in _RADIO)
WARM_START = "learner.warm_start"
_FIRST = ("learner.name", "policy.memory")
"""keys that name a group before all others, which often follow from them"""
_OF_SECTION = ("setup", "world", "edition", "env.horizon", "env.grid")

Frame = Any
"""a pandas table; the types that pandas infers for its parts are too wide to be checked"""


def runs_table(runs: Sequence[EvaluatedRun]) -> tuple[Frame, list[LeftOut]]:
    """Returns one row per evaluation of a run, by section, label and seed, and the runs left out.

    Of several runs of a label with one seed, the last by name is used, and a copy of the package's
    policy only if there is no other.
    """
    runs = sorted(runs, key=lambda run: (not pretrained.is_copy(run.path), run.path.name))
    of_section = settings_table(pd.Series([_of_section(run) for run in runs]))
    table: Frame = pd.DataFrame([_row(run) for run in runs])
    table["section"] = named(table["section"], of_section.drop(columns=["setup", "world"]))
    parts = [named(p["label"], settings_table(p["settings"])) for _, p in table.groupby("section")]
    other = table["evaluated_with"].map(lambda text: text and f", evaluated with {text}")
    table["label"] = pd.concat(parts) + other
    twice = table.duplicated(["section", "label", "seed"], keep="last")
    left_out = [
        (row["run"], f"seed {row['seed']} of {row['label']} is there twice")
        for row in table[twice].to_dict("records")
    ]
    return table[~twice].sort_values(["section", "label", "seed"], ignore_index=True), left_out


def _of_section(run: EvaluatedRun) -> dict[str, Any]:
    """Returns the settings that are the same for all runs of a section."""
    about = {k: v for k, v in run.settings.items() if k in _OF_SECTION or k.startswith("fire.")}
    tested = run.evaluation
    sets = ", ".join(tested.results)
    return about | {"fires": tested.fires, "start_seed": tested.start_seed, "held_out": sets}


def _row(run: EvaluatedRun) -> dict[str, Any]:
    setup, world, fire = (run.settings[key] for key in ("setup", "world", "fire.name"))
    changed = ", ".join(f"{key}={word(value)}" for key, value in run.evaluated_with.items())
    return {
        "section": f"setup {setup}, world {world}, trained on {fire}",
        **{"label": run.name, "run": str(run.path), "method": run.settings["method"]},
        **{"setup": setup, "world": world, "trained_on": fire, "radio": radio_text(run.now)},
        **{"evaluated_with": changed, "seed": run.settings["seed"]},
        **{"settings": trained_with(run), "as_trained": not changed, "object": run},
    }


def trained_with(run: EvaluatedRun) -> dict[str, str]:
    """Returns the settings that affect training, as on the command line, but not the seed's."""
    settings = {k: word(v) for k, v in run.settings.items() if k.split(".")[0] not in NOT_COMPARED}
    if start := settings.get(WARM_START):  # each seed has another start
        settings[WARM_START] = without_time_and_seed(start)
    return settings


def word(value: Any) -> str:
    """Returns a value as on the command line."""
    if isinstance(value, float):
        return str(int(value) if value.is_integer() else value)
    return value if isinstance(value, str) else json.dumps(value, default=str)


def settings_table(rows: Frame) -> Frame:
    """Returns settings as text, one column per key, with "" for a missing key."""
    words = [{key: word(value) for key, value in row.items()} for row in rows]
    return pd.DataFrame(words, rows.index, dtype=object).fillna("")


def trained_settings(runs: Frame) -> Frame:
    """Returns the settings that affect training, one row per label."""
    first = runs[runs["as_trained"]].drop_duplicates("label").set_index("label")
    return settings_table(first["settings"])


def named(names: Frame, settings: Frame) -> Frame:
    """Adds to each name, in brackets, the settings that tell it from others of the same name.

    The value that more than half of the distinct settings have is not named.
    """
    distinct = settings.drop_duplicates()
    result = names.copy()
    for _, rows in settings.groupby(names):
        keys = telling_apart(rows)
        shares = {k: distinct[k][distinct[k] != ""].value_counts(normalize=True) for k in keys}
        for place, row in rows[keys].iterrows():
            told = ", ".join(
                f"{key.replace('learner.name', 'learner')}={value}"
                for key, value in row.items()
                if value != "" and shares[key][value] <= 0.5
            )
            result[place] += f" ({told})" if told else ""
    return result


def telling_apart(settings: Frame) -> list[str]:
    """Returns keys that tell distinct rows apart; none that follows from those before it."""
    keys: list[str] = []
    parts, varied = 1, settings.columns[settings.nunique() > 1]
    for key in sorted(varied, key=lambda key: (key not in _FIRST, key == WARM_START)):
        if (more := len(settings[[*keys, key]].drop_duplicates())) > parts:
            keys, parts = [*keys, key], more
    return keys


def radio_text(settings: Mapping[str, Any]) -> str:
    """Returns the radio of an evaluation, such as "off", "no limits" or "range 10, loss 0.2"."""
    reach, loss, most, burst, delay, fade, shared = (settings.get(key) for key in RADIO)
    reach = math.inf if reach is None else float(reach)
    if reach == 0:
        return "off"
    parts = [f"range {word(reach)}"] if reach < math.inf else []
    parts += [f"loss {word(loss)}"] if loss else []
    parts += [f"spells of {word(burst)}"] if loss and burst not in (None, 1) else []
    parts += [f"delay {word(delay)}"] if delay else []
    parts += ["fade"] if fade and reach < math.inf else []
    parts += [f"{word(most)} bytes{' shared' * bool(shared)}"] if most is not None else []
    return ", ".join(parts) or "no limits"


def means_table(runs: Frame) -> Frame:
    """Returns one row per run, set of fires, policy and measure.

    Columns: the first of `runs_table`, up to seed; `values` (one per fire); `value` (their mean).
    """
    columns = list(runs.columns[: runs.columns.get_loc("seed") + 1])
    rows = [
        (*row[: len(columns)], policy, fires, measure, values, math.fsum(values) / len(values))
        for row in runs.itertuples(index=False)
        for fires, policies in row.object.evaluation.results.items()
        for policy, measured in policies.items()
        for measure, values in measured.items()
    ]
    return pd.DataFrame(rows, columns=[*columns, "policy", "fires", "measure", "values", "value"])


def learned(means: Frame) -> Frame:
    """Returns the rows of trained policies."""
    return means[means["policy"] == LEARNED]


def by_fire(means: Frame) -> Values:
    """Returns the values of rows of `means_table`, float64 [rows, fires]."""
    return np.array(means["values"].tolist(), float)
