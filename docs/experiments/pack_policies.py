"""Adds finished runs to the trained policies that are installed with emberlink.

python docs/experiments/pack_policies.py RUN... policies/pretrained
"""

import shutil
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from emberlink.envs.fire_files.config import COPY_FILE
from emberlink.envs.utils.errors import UserError
from emberlink.trainers.learners.base import ACTOR
from emberlink.trainers.runs import checkpoint
from emberlink.trainers.runs.pretrained import collection, is_name
from emberlink.trainers.runs.run_folder import NEWEST, RunFolder


def pack(run: RunFolder, into: Path) -> Path:
    """Copies a finished run to the trained policies, without training states and critics."""
    trained = run.config(device="cpu")
    learner: Any = trained.learner
    if (start := getattr(learner, "warm_start", "")) and not is_name(start):
        learner = replace(learner, warm_start=f"runs/{Path(start).name}")  # no local path
    config = replace(trained, output="runs", logger="none", device="cpu", learner=learner)
    if len(run.metrics()) < config.episodes or not run.evaluated():
        raise UserError(f"{run.path}: not finished, or not evaluated")
    target = into / collection(config) / config.method / f"s{config.seed}"
    if target.exists():
        raise UserError(f"{target}: exists already")
    actors = checkpoint.read_tensors(run.newest, f"{checkpoint.WEIGHTS}{ACTOR}")
    target.mkdir(parents=True)
    checkpoint.write(
        target / NEWEST,
        checkpoint.header_of(config, run.step()),
        {f"{checkpoint.WEIGHTS}{ACTOR}{name}": value for name, value in actors.items()},
    )
    RunFolder(target).write_config(config)
    for file in ("metrics.jsonl", "eval.json", COPY_FILE):
        if (run.path / file).is_file():
            shutil.copyfile(run.path / file, target / file)
    return target


if __name__ == "__main__":
    *runs, into = sys.argv[1:]
    for path in runs:
        print(pack(RunFolder(path), Path(into)))
