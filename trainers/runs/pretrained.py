"""Opens the trained policies of the package (`pretrained:consensus`), and adds runs to them.

Each is a reduced run folder, policies/pretrained/SETUP/METHOD/sSEED, with config.yaml,
metrics.jsonl, eval.json, and a checkpoint of the actors. SETUP is `collection`: the setup, and the
world if it is not `paper`. Finished runs are packed with

    python -m emberlink.trainers.runs.pretrained RUN... policies/pretrained
"""

import re
import shutil
import sys
from dataclasses import replace
from fnmatch import fnmatch
from importlib.resources import files
from pathlib import Path
from typing import Any

from emberlink.envs.fire_files.config import COPY_FILE
from emberlink.envs.utils.errors import UserError, naming
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.learners.base import ACTOR
from emberlink.trainers.runs import checkpoint
from emberlink.trainers.runs.run_folder import NEWEST, RunFolder

PREFIX = "pretrained:"
_COPY = "pretrained"
"""beginning of the names of copies in an output folder"""
USUAL_SETUPS = ("tuned", "strong_front")
"""where a method without a setup is looked for, in this order"""


def is_name(text: str) -> bool:
    """Returns whether a text names a trained policy of the package and not a folder."""
    return text.startswith(PREFIX)


def read_run(text: str) -> RunFolder:
    """Returns the run of a folder, or of `pretrained:[SETUP/]METHOD[/SEED]`, to be read.

    SETUP is such as `tuned` or, for the world front, `strong_front`.
    """
    return RunFolder(find_one(text) if is_name(text) else text)


def open_run(text: str, output: Path | str = "runs") -> RunFolder:
    """Returns the run of `read_run`, to be written to.

    A trained policy of the package is copied to a run folder in `output`, unless there is a copy.
    """
    if not is_name(text):
        return RunFolder(text)
    source = find_one(text)
    run = RunFolder(Path(output) / "_".join([_COPY, *source.parts[-3:]]))
    with naming(run.path):
        run.path.mkdir(parents=True, exist_ok=True)
        if not run.newest.exists():
            # The checkpoint last, and without modes: an installed package may be read-only.
            for file in sorted(source.iterdir(), key=lambda file: file.name == NEWEST):
                shutil.copyfile(file, run.path / file.name)
        if run.newest.read_bytes() != (source / NEWEST).read_bytes():
            raise UserError(f"holds other networks than {text} of this version; move it away")
    return run


def is_copy(folder: Path) -> bool:
    """Returns whether a run folder has the name of a copy that `open_run` makes."""
    return folder.name.startswith(f"{_COPY}_")


def find(text: str) -> list[Path]:
    """Returns the folders of the trained policies that match a name, lowest seed first.

    `pretrained:SETUP` matches all policies of a setup. A method alone matches its policies in the
    first of `USUAL_SETUPS` that has it, else in all setups.
    """
    folders = sorted((file.parent for file in _shipped().glob("*/*/*/config.yaml")), key=_order)
    name = text.removeprefix(PREFIX).strip("/")
    wanted = tuple(re.sub(r"/(\d+)$", r"/s\1", name).split("/"))
    matching = [path for path in folders if path.parts[-3:][: len(wanted)] == wanted]
    for setups in (*USUAL_SETUPS, "*"):
        matching = matching or [
            p for p in folders if fnmatch(p.parts[-3], setups) and p.parts[-2] == name
        ]
    if not matching:
        known = ", ".join("/".join(path.parts[-3:]) for path in folders)
        raise UserError(f"{text}: no such trained policy; known: {known}")
    return matching


def find_one(text: str) -> Path:
    """Returns the folder of the trained policy with a name and, among several, the lowest seed."""
    policies = find(text)
    recipes = sorted({"/".join(folder.parts[-3:-1]) for folder in policies})
    if len(recipes) > 1:
        raise UserError(f"{text} is ambiguous: {', '.join(recipes)}")
    return policies[0]


def collection(config: RunConfig) -> str:
    """Returns the folder of a run's trained policies: its setup, and its world unless `paper`."""
    return config.setup if config.world == "paper" else f"{config.setup}_{config.world}"


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


def _shipped() -> Path:
    return Path(str(files("emberlink.policies"))) / "pretrained"


def _order(folder: Path) -> tuple[str, str, int]:
    setup, method, seed = folder.parts[-3:]
    return setup, method, int(seed.removeprefix("s"))


if __name__ == "__main__":
    *runs, into = sys.argv[1:]
    for path in runs:
        print(pack(RunFolder(path), Path(into)))
