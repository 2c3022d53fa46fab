"""Compares runs and holds the results as tables."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from emberlink.envs.utils.errors import UserError, unknown
from emberlink.trainers.comparison import bootstrap, rankings, tables
from emberlink.trainers.comparison.bootstrap import Interval
from emberlink.trainers.comparison.claims import verdicts
from emberlink.trainers.comparison.communication import communication_values
from emberlink.trainers.comparison.reading import LeftOut, read_all
from emberlink.trainers.comparison.tables import Frame


class Difference(NamedTuple):
    """How far one interquartile mean is above another, over seeds and fires."""

    value: float
    interval: Interval | None
    p: float | None
    """two-sided p-value, None with one seed; `bootstrap.holm` corrects several"""


@dataclass(frozen=True, repr=False)
class Comparison:
    """The results of a comparison, as pandas tables."""

    runs: Frame
    """one row per evaluation of a run"""
    means: Frame
    """one row per run, set of fires, policy and measure"""
    ranking: Frame
    """one row per set of fires, measure and label, best first; see `rankings.RANKING`"""
    claims: Frame
    """verdicts of the paper's claims; see `claims.COLUMNS`"""
    communication: Frame
    """gain of messages and value of communication; see `communication.COLUMNS`"""
    curves: Frame
    """one row per label, measure and training episode"""
    notes: list[str]
    """remarks on differences between runs and on missing results"""
    left_out: list[LeftOut]
    """folders and files that are not compared, with the reason"""

    def __repr__(self) -> str:
        rows = self.runs.groupby("section")["label"].nunique()
        told = "".join(f"\n  {section}: {count} rows" for section, count in rows.items())
        return f"Comparison of {self.runs['run'].nunique()} runs{told}"

    @property
    def table(self) -> Frame:
        """One row per run, policy, fire and measure; `fire` counts from 0 in its set."""
        table = self.means.drop(columns="value").rename(columns={"values": "value"})
        table = table.explode("value")
        table.insert(table.columns.get_loc("measure"), "fire", table.groupby(level=0).cumcount())
        return table.astype({"value": float}).reset_index(drop=True)

    @property
    def sections(self) -> list[str]:
        """The names of the sections."""
        return list(self.runs["section"].unique())

    def difference(
        self, first: str, second: str, measure: str, fires: str = "", section: str = ""
    ) -> Difference:
        """Returns by how much the interquartile mean of the label `first` is above `second`'s.

        `fires` and `section` may be empty if there is only one. A UserError if a name is not known,
        the measure is not ranked, or both labels are evaluations of the same runs, which are not
        independent samples.
        """
        trained, means = tables.learned(self.ranking), tables.learned(self.means)
        for column, name in (("section", section), ("fires", fires), ("measure", measure)):
            name = _one(column, name, trained[column].unique())
            trained, means = (part[part[column] == name] for part in (trained, means))
        if why := trained["not_ranked"].iloc[0]:
            raise UserError(f"{measure} has no differences: {why}")
        known = trained["label"].unique()
        parts = [means[means["label"] == _one("label", label, known)] for label in (first, second)]
        if parts[0]["run"].isin(parts[1]["run"]).any():
            raise UserError(f"{first!r} and {second!r} are evaluations of the same runs")
        iqms = [float(bootstrap.iqm(part["value"].to_numpy(float))) for part in parts]
        samples = [tables.by_fire(part) for part in parts]
        ends = bootstrap.crossed_interval(bootstrap.iqm_difference, *samples)
        p = bootstrap.crossed_p(bootstrap.iqm_difference, *samples)
        return Difference(iqms[0] - iqms[1], ends, p)

    def to_json(self) -> str:
        """Returns all results as JSON, with the text "inf" for infinite numbers."""
        of_label = self.curves.groupby(["section", "label", "measure"], sort=False)
        values = {
            "settings": about(),
            "left_out": [{"run": path, "why": why} for path, why in self.left_out],
            "notes": self.notes,
            "runs": _records(self.runs.drop(columns=["object", "settings"])),
            "ranking": _records(self.ranking),
            "claims": _records(self.claims),
            "communication": _records(self.communication),
            "curves": _records(of_label[["iqm", "low", "high"]].agg(list).reset_index()),
        }
        return json.dumps(values, indent=1, allow_nan=False) + "\n"


def _records(table: Frame) -> list[dict[str, Any]]:
    """Returns the rows of a table as plain values: None for missing, "inf" for infinite numbers."""
    text = table.replace(np.inf, "inf").to_json(orient="records", double_precision=15)
    return json.loads(text)


def _one(what: str, name: str, known: Sequence[str]) -> str:
    """Returns a name if it is known, or the only known one for an empty name."""
    if not name and len(known) == 1:
        return known[0]
    if name not in known:
        raise UserError(f"{what} {unknown(name, list(known))}")
    return name


def about() -> dict[str, Any]:
    """Returns the settings of the statistics and the versions of the libraries."""
    return {
        "emberlink": version("emberlink"),
        "scipy": version("scipy"),
        "level": bootstrap.LEVEL,
        "resamples": bootstrap.RESAMPLES,
        "curve_resamples": bootstrap.BAND_RESAMPLES,
        "bootstrap_seed": bootstrap.BOOTSTRAP_SEED,
        "few_seeds": bootstrap.FEW,
    }


def compare_runs(paths: Sequence[Path], labels: Sequence[str] = ()) -> Comparison:
    """Compares runs; arguments as for `emberlink.trainers.compare`."""
    if not paths:
        raise UserError("nothing to compare: expected at least one run folder")
    read, left_out = read_all(paths, labels)
    if not read:
        path, why = left_out[0]
        raise UserError(f"no finished run among {len(left_out)}: nothing to compare; {path}: {why}")
    runs, others = tables.runs_table(read)
    means = tables.means_table(runs)
    notes: list[str] = []
    parts: list[tuple[Frame, ...]] = []
    for section, part in runs.groupby("section"):
        of_section = means[means["section"] == section]
        claims, found = verdicts(part, of_section)
        ranking, curves = rankings.rank(part, of_section), rankings.curves(part)
        parts.append((ranking, claims, communication_values(part), curves))
        if apart := list(rankings.differing(part)):
            found.append(f"the rows differ in {', '.join(apart)}")
        notes += [f"{section}: {note}" for note in found]
    ranking, claims, communication, curves = (
        pd.concat([table for table in column if len(table)] or column[:1], ignore_index=True)
        for column in zip(*parts, strict=True)
    )
    left_out += others
    return Comparison(runs, means, ranking, claims, communication, curves, notes, left_out)
