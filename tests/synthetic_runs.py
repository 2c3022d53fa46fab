"""Writes run folders with synthetic numbers."""

import json
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from emberlink.envs import metrics
from emberlink.trainers.config.compose import resolve, to_values

HORIZON = 40
Numbers = dict[str, Any]
SCRIPTED: dict[str, Numbers] = {"random_actions": {}, "random_waypoints": {}}


@cache
def _values(method: str, overrides: tuple[str, ...]) -> dict[str, Any]:
    return to_values(resolve(method, ("setup=tuned", f"env.horizon={HORIZON}", *overrides)))


def write_run(
    folder: Path,
    method: str = "consensus",
    seed: int = 0,
    *,
    name: str | None = None,
    overrides: tuple[str, ...] = (),
    episodes: int = 3,
    fires: int = 4,
    learned: Numbers | None = None,
    scripted: Mapping[str, Numbers] = SCRIPTED,
) -> Path:
    """Writes a finished, evaluated run without checkpoints and returns its folder.

    Args:
        learned: the learned policy's numbers: measure -> a number, or a list with one number per
            held-out fire. Missing measures are random.
        scripted: the same for each scripted policy.
    """
    config = {**_values(method, (f"episodes={episodes}", *overrides)), "seed": seed}
    run = folder / (name or f"{method}_{config['setup']}_s{seed}")
    run.mkdir(parents=True)
    (run / "config.yaml").write_text(yaml.safe_dump(config, sort_keys=False))
    generator = np.random.default_rng([seed, *method.encode()])
    lines = [
        {
            "episode": e,
            **{m: float(v) for m, v in zip(metrics.NAMES, generator.random(8), strict=True)},
        }
        for e in range(1, episodes + 1)
    ]
    (run / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    everyones = np.random.default_rng(7)

    def drawn(generator: np.random.Generator, given: Numbers) -> dict[str, list[float]]:
        numbers = {m: (60 * generator.random(fires)).tolist() for m in metrics.NAMES}
        return numbers | {m: np.full(fires, v, float).tolist() for m, v in given.items()}

    results = {"learned": drawn(generator, learned or {})}
    results |= {policy: drawn(everyones, given) for policy, given in scripted.items()}
    write_evaluation(
        run,
        {
            "method": method,
            "setup": config["setup"],
            "world": config["world"],
            "seed": seed,
            "start_seed": 1,
            "fires": fires,
            "results": {"huygens": results},
        },
    )
    return run


def read_evaluation(run: Path) -> dict[str, Any]:
    """Returns the contents of eval.json."""
    return json.loads((run / "eval.json").read_text())


def write_evaluation(run: Path, content: Any) -> None:
    """Writes eval.json."""
    (run / "eval.json").write_text(json.dumps(content))


def evaluate_otherwise(run: Path, radio: dict[str, float], name: str = "", **coverage: Any) -> None:
    """Writes an evaluation with another radio and coverage by policy."""
    content = read_evaluation(run) | {"environment": {"radio": radio}}
    for policy, value in coverage.items():
        content["results"]["huygens"][policy]["coverage"] = np.full(4, value, float).tolist()
    (run / (name or f"eval_{radio}.json")).write_text(json.dumps(content))
