"""Converts a comparison to plain values and JSON."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from importlib.metadata import version
from typing import Any

from emberlink.trainers.comparison import bootstrap
from emberlink.trainers.comparison.rankings import Numbers
from emberlink.trainers.comparison.runs import LeftOut
from emberlink.trainers.runs.compact_json import finite


def settings() -> dict[str, Any]:
    """Returns the settings of the statistics and the versions of the libraries."""
    return {
        "emberlink": version("emberlink"),
        "scipy": version("scipy"),
        "mean": "interquartile mean (scipy.stats.trim_mean, 0.25)",
        "interval": "percentile bootstrap, stratified by method (scipy.stats.bootstrap)",
        "level": bootstrap.LEVEL,
        "resamples": bootstrap.RESAMPLES,
        "curve_resamples": bootstrap.BAND_RESAMPLES,
        "bootstrap_seed": bootstrap.BOOTSTRAP_SEED,
        "few_seeds": bootstrap.FEW,
    }


def to_values(
    command: str,
    sections: Sequence[Numbers],
    left_out: Sequence[LeftOut],
    notes: Sequence[str],
) -> dict[str, Any]:
    """Returns the content of compare.json."""
    return {
        "settings": settings(),
        "command": command,
        "left_out": [{"run": path, "why": why} for path, why in left_out],
        "notes": list(notes),
        "setups": [_section(section) for section in sections],
    }


def to_json(values: Any) -> str:
    """Returns values as JSON, with the text "inf" for infinite numbers."""
    return json.dumps(finite(values), indent=1, allow_nan=False) + "\n"


def _section(numbers: Numbers) -> dict[str, Any]:
    section = numbers.section
    return {
        "setup": section.label,
        "trained_on": section.trained_on,
        "runs": [
            {
                "run": str(run.path),
                "method": group.label,
                "seed": run.config.seed,
                "episodes": run.config.episodes,
                "num_envs": run.config.num_envs,
                "evaluated_with": dict(run.evaluated_with),
                "checkpoint": run.evaluation.checkpoint,
                "held_out_fires": run.evaluation.fires,
            }
            for group in section.groups
            for run in group.runs
        ],
        "fires": {
            fire: [asdict(ranking) for ranking in rankings]
            for fire, rankings in numbers.fires.items()
        },
        "claims": [asdict(verdict) for verdict in numbers.verdicts],
        "communication": [asdict(value) for value in numbers.communication],
        "curves": {
            measure: {method: asdict(curve) for method, curve in by_method.items()}
            for measure, by_method in numbers.curves.items()
        },
    }
