"""Adds finished runs to the trained policies that are installed, or to an archive.

python docs/experiments/pack_policies.py RUN... policies/pretrained/tuned/consensus
python docs/experiments/pack_policies.py RUN... docs/weights/ARM.tar.xz   # rounded to 16 bits
"""

import shutil
import sys
import tarfile
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from emberlink.envs.fire_files.config import COPY_FILE
from emberlink.envs.utils.errors import UserError
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.learners.base import ACTOR
from emberlink.trainers.runs import checkpoint
from emberlink.trainers.runs.pretrained import is_name
from emberlink.trainers.runs.run_folder import NEWEST, RunFolder


def reduced(run: RunFolder) -> RunConfig:
    """Returns the configuration of a finished run without settings of one machine."""
    trained = run.config(device="cpu")
    learner: Any = trained.learner
    if (start := getattr(learner, "warm_start", "")) and not is_name(start):
        learner = replace(learner, warm_start=f"runs/{Path(start).name}")
    if len(run.metrics()) < trained.episodes or not run.evaluated():
        raise UserError(f"{run.path}: not finished, or not evaluated")
    return replace(trained, output="runs", logger="none", device="cpu", learner=learner)


def pack(run: RunFolder, target: Path, *, half: bool = False) -> Path:
    """Copies a finished run without training states and critics; with `half`, the actors alone."""
    config, prefix = reduced(run), f"{checkpoint.WEIGHTS}{ACTOR}"
    actors = checkpoint.read_tensors(run.newest, prefix)
    target.mkdir(parents=True)
    kept = {
        f"{prefix}{name}": value.half().float() if half else value for name, value in actors.items()
    }
    checkpoint.write(target / NEWEST, checkpoint.header_of(config, run.step()), kept)
    RunFolder(target).write_config(config)
    for file in () if half else ("metrics.jsonl", "eval.json", COPY_FILE):
        if (run.path / file).is_file():
            shutil.copyfile(run.path / file, target / file)
    return target


def main(*texts: str) -> None:
    """Packs runs into a folder or an archive, each as sSEED beside those that are there."""
    runs, into = [RunFolder(text) for text in texts[:-1]], Path(texts[-1])
    half, arm = into.suffix == ".xz", into.name.partition(".")[0]
    with TemporaryDirectory() as scratch:
        if half and into.exists():
            with tarfile.open(into) as archive:
                archive.extractall(scratch, filter="data")
        folder = Path(scratch) / arm if half else into
        for run in runs:
            pack(run, folder / f"s{run.config(device='cpu').seed}", half=half)
        if half:
            with tarfile.open(into, "w:xz") as archive:
                archive.add(folder, arm)


if __name__ == "__main__":
    main(*sys.argv[1:])
