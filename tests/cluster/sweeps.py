"""Helpers of the cluster tests: twelve short runs, and their results."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from tiny_run import TINY

from emberlink.trainers.runs.run_folder import RunFolder

METHODS = ("independent", "shared_memory", "positional", "consensus")
SETTINGS = [
    *(word for word in TINY if not word.startswith("episodes=")),
    *("episodes=16", "checkpoint_steps=30", "seed=0,1,2", "output=runs"),
    *("evaluation.scripted=[]", "evaluation.huygens=false", "fire.num_train_fires=2"),
]
ARGUMENTS = [*METHODS, *SETTINGS]
"""four methods x three seeds; a training takes a few seconds"""
RUNS = 12
PATIENCE = 900.0


def start(
    folder: Path, *more: str, env: Mapping[str, str] | None = None, methods: Sequence[str] = METHODS
) -> subprocess.Popen:
    """Starts the sweep as a process in a folder; its output is in `sweep.txt`."""
    keys = {text.partition("=")[0] for text in more}
    kept = [text for text in SETTINGS if text.partition("=")[0] not in keys]
    with (folder / "sweep.txt").open("ab") as log:
        return subprocess.Popen(
            [sys.executable, "-m", "emberlink.trainers.cli", "sweep", *methods, *kept, *more],
            cwd=folder,
            env={**(env or os.environ)},
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
        )


def finish(process: subprocess.Popen, folder: Path) -> None:
    """Waits for a sweep, which must succeed."""
    status = process.wait(PATIENCE)
    assert status == 0, (folder / "sweep.txt").read_text()


def runs_in(folder: Path) -> list[RunFolder]:
    """Returns the runs of a sweep that has been started in a folder."""
    return [RunFolder(file.parent) for file in sorted(folder.glob("runs/*/config.yaml"))]


def training(folder: Path) -> list[RunFolder]:
    """Returns the runs that have saved a checkpoint and are not near their end."""
    return [run for run in runs_in(folder) if 4 <= len(run.metrics()) <= 11]


def finished(folder: Path) -> int:
    """Returns how many runs the sweeps of a folder have reported as finished."""
    return (folder / "sweep.txt").read_text().count(": finished")


def wait_for(condition: Callable[[], object], process: subprocess.Popen | None = None) -> None:
    """Waits until a condition is true."""
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline
        assert process is None or process.poll() is None, "the sweep has ended"
        time.sleep(0.1)


def resumed(folder: Path) -> int:
    """Returns how often a training was resumed in its middle."""
    text = "".join(file.read_text() for file in folder.glob("runs/logs/*.txt"))
    return text.count("resumed at step")


def results(folder: Path) -> dict[str, dict[str, bytes]]:
    """Returns the files of each run that must not depend on where it was trained."""
    rows = json.loads((folder / "runs" / "sweep.json").read_text())["runs"]
    assert [row["state"] for row in rows] == ["finished"] * RUNS
    assert len({row["folder"] for row in rows}) == RUNS == len(runs_in(folder))
    return {row["folder"]: _files(RunFolder(folder / "runs" / row["folder"])) for row in rows}


def _files(run: RunFolder) -> dict[str, bytes]:
    names = ("config.yaml", "metrics.jsonl", "eval.json")
    return {
        **{name: (run.path / name).read_bytes() for name in names},
        "networks": run.checkpoint().read_bytes(),
        "best": (run.checkpoints / "best.safetensors").read_bytes(),
    }
