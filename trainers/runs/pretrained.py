"""Opens the trained policies of the package (`pretrained:consensus`), and adds runs to them.

Each is a reduced run folder, policies/pretrained/SETUP/METHOD/sSEED, with config.yaml,
metrics.jsonl, eval.json, and a checkpoint of the actors. SETUP is `collection`: the setup, and the
world if it is not `paper`. Finished runs are packed with

    python -m emberlink.trainers.runs.pretrained RUN... --into policies/pretrained
"""

import argparse
import shutil
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any

from emberlink.envs.fire_files.config import COPY_FILE
from emberlink.envs.utils.errors import UserError
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.learners.base import ACTOR
from emberlink.trainers.runs import checkpoint
from emberlink.trainers.runs.run_folder import RunFolder

PREFIX = "pretrained:"
_COPY = "pretrained"
"""beginning of the names of copies in an output folder"""
USUAL_SETUPS = ("tuned", "strong_front")
"""where a method without a setup is looked for, in this order"""


def is_name(text: str) -> bool:
    """Returns whether a text names a trained policy of the package and not a folder."""
    return text.startswith(PREFIX)


def open_run(text: str, output: Path | str = "runs") -> RunFolder:
    """Returns the run that an argument of the command line names.

    A trained policy of the package is copied to a run folder in `output`, unless there is a copy.

    Args:
        text: a run folder, or `pretrained:METHOD`, `pretrained:SETUP/METHOD` or
            `pretrained:SETUP/METHOD/SEED`, where SETUP is such as `tuned` or, for the world
            front, `strong_front`.
        output: folder of run folders.

    Raises:
        UserError: there is no such policy, or several; the message lists the known ones.
    """
    run = read_run(text, output)
    if not is_name(text) or is_copy(run.path):
        return run
    target = _copy_of(run.path, output)
    try:
        _copy(run.path, target)
    except OSError as error:
        raise UserError(f"{target}: cannot be created: {error.strerror or error}") from None
    return RunFolder(target)


def read_run(text: str, output: Path | str = "runs") -> RunFolder:
    """Returns the run that an argument of the command line names, to be read.

    Nothing is written: a trained policy of the package is its copy in `output`, or the installed
    folder if there is no copy.

    Raises:
        UserError: there is no such policy, or several; or the copy holds other networks.
    """
    if not is_name(text):
        return RunFolder(text)
    source = find_one(text)
    target = _copy_of(source, output)
    if not target.exists():
        return RunFolder(source)
    if not _is_copy(source, target):
        raise UserError(
            f"{target}: holds other networks than {text} of this version of emberlink; move it away"
        )
    return RunFolder(target)


def _copy_of(source: Path, output: Path | str) -> Path:
    """Returns the folder of the copy of a trained policy of the package."""
    return Path(output) / "_".join([_COPY, *source.parts[-3:]])


def is_copy(folder: Path) -> bool:
    """Returns whether a run folder has the name of a copy that `open_run` makes."""
    return folder.name.startswith(f"{_COPY}_")


def _is_copy(source: Path, target: Path) -> bool:
    """Returns whether a run folder has no other networks than a policy of the package."""
    mine, theirs = RunFolder(target).newest, RunFolder(source).newest
    try:
        return not mine.exists() or mine.read_bytes() == theirs.read_bytes()
    except OSError as error:
        raise UserError(f"{mine}: cannot be read: {error.strerror or error}") from None


def find(text: str) -> list[Path]:
    """Returns the folders of the trained policies that match a name, lowest seed first.

    Args:
        text: see `open_run`; `pretrained:SETUP` matches all policies of a setup. A method alone
            matches its policies in the first of `USUAL_SETUPS` that has it, else in all setups.

    Raises:
        UserError: there is no such policy.
    """
    folders = sorted((file.parent for file in _shipped().glob("*/*/*/config.yaml")), key=_order)
    name = text.removeprefix(PREFIX).strip("/")
    wanted = name.split("/")
    if len(wanted) == 3:
        wanted[2] = f"s{wanted[2].removeprefix('s')}"
    matching = [path for path in folders if path.parts[-3:][: len(wanted)] == tuple(wanted)]
    of_method = [path for path in folders if path.parts[-2] == name]
    usual = of_method
    for setup in reversed(USUAL_SETUPS):
        usual = [path for path in of_method if path.parts[-3] == setup] or usual
    if not matching and not usual:
        seeds = [path.name[1:] for path in folders if [*path.parts[-3:-1]] == wanted[:2]]
        if seeds:
            known = f"{'/'.join(wanted[:2])} has the seeds {', '.join(seeds)}"
            raise UserError(f"{text}: no such trained policy; {known}")
        known = ", ".join(sorted({"/".join(path.parts[-3:-1]) for path in folders})) or "none"
        raise UserError(f"{text}: no such trained policy; known: {known}")
    return matching or usual


def find_one(text: str) -> Path:
    """Returns the folder of the trained policy with a name and, among several, the lowest seed.

    Raises:
        UserError: there is no such policy, or the name matches several methods or setups.
    """
    policies = find(text)
    recipes = sorted({"/".join(folder.parts[-3:-1]) for folder in policies})
    if len(recipes) > 1:
        raise UserError(f"{text} is ambiguous: {', '.join(recipes)}")
    return policies[0]


def collection(config: RunConfig) -> str:
    """Returns the folder of a run's trained policies: its setup, and its world unless `paper`."""
    return config.setup if config.world == "paper" else f"{config.setup}_{config.world}"


def pack(run: RunFolder, into: Path) -> Path:
    """Copies a finished run to the trained policies, without training states and critics.

    Returns:
        The new folder.

    Raises:
        UserError: the run is not finished, or the new folder exists.
    """
    trained = run.config(device="cpu")
    learner = _without_path(trained.learner)
    config = replace(trained, output="runs", logger="none", device="cpu", learner=learner)
    if len(run.metrics()) < config.episodes or not run.evaluated():
        raise UserError(f"{run.path}: not finished, or not evaluated")
    target = into / collection(config) / config.method / f"s{config.seed}"
    if target.exists():
        raise UserError(f"{target}: exists already")
    actors = checkpoint.read_tensors(run.newest, f"{checkpoint.WEIGHTS}{ACTOR}")
    target.mkdir(parents=True)
    checkpoint.write(
        target / run.newest.name,
        checkpoint.header_of(config, run.step()),
        {f"{checkpoint.WEIGHTS}{ACTOR}{name}": value for name, value in actors.items()},
    )
    RunFolder(target).write_config(config)
    for file in ("metrics.jsonl", "eval.json", COPY_FILE):
        if (run.path / file).is_file():
            shutil.copyfile(run.path / file, target / file)
    return target


def _without_path(learner: Any) -> Any:
    """Returns the settings of a learner with a path shortened to `warm_start=runs/NAME`."""
    start = getattr(learner, "warm_start", "")
    if not start or is_name(start):
        return learner
    return replace(learner, warm_start=f"runs/{Path(start).name}")


def _shipped() -> Path:
    return Path(str(files("emberlink.policies"))) / "pretrained"


def _order(folder: Path) -> tuple[str, str, int]:
    setup, method, seed = folder.parts[-3:]
    return setup, method, int(seed.removeprefix("s"))


def _copy(source: Path, target: Path) -> None:
    """Copies a folder completely or not at all."""
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=target.parent, prefix=".pretrained") as partial:
        # Without modes, since an installed package may be read-only.
        for file in (path for path in source.rglob("*") if path.is_file()):
            copy = Path(partial, "run", file.relative_to(source))
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, copy)
        Path(partial, "run").rename(target)


def main(arguments: Sequence[str] | None = None) -> int:
    """Packs the runs named on the command line and returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m emberlink.trainers.runs.pretrained")
    parser.add_argument("runs", metavar="RUN", nargs="+", type=Path)
    parser.add_argument("--into", type=Path, required=True, help="policies/pretrained")
    options = parser.parse_args(arguments)
    try:
        for run in options.runs:
            print(pack(RunFolder(run), options.into))
    except ValueError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
