"""Opens the trained policies of the package (`pretrained:consensus`).

Each is a reduced run folder, policies/pretrained/SETUP/METHOD/sSEED, with config.yaml,
metrics.jsonl, eval.json, and a checkpoint of the actors. SETUP is also a study, whose METHODs are
its arms. docs/experiments/pack_policies.py makes them of finished runs.
"""

import re
import shutil
from fnmatch import fnmatch
from importlib.resources import files
from pathlib import Path

from emberlink.envs.utils.errors import UserError, naming
from emberlink.trainers.runs.run_folder import RunFolder

PREFIX = "pretrained:"
_COPY = "pretrained"
"""beginning of the names of copies in an output folder"""
USUAL_SETUPS = ("tuned", "study_front")
"""where a method without a setup is looked for, in this order"""


def is_name(text: str) -> bool:
    """Returns whether a text names a trained policy of the package and not a folder."""
    return text.startswith(PREFIX)


def read_run(text: str) -> RunFolder:
    """Returns the run of a folder, or of `pretrained:[SETUP/]METHOD[/SEED]`, to be read.

    SETUP is such as `tuned` or `study_front`.
    """
    return RunFolder(find_one(text) if is_name(text) else text)


def open_run(text: str) -> RunFolder:
    """Returns the run of `read_run`, to be written to.

    A trained policy of the package is copied to a run folder in `runs`, unless there is a copy.
    """
    if not is_name(text):
        return RunFolder(text)
    source = find_one(text)
    run = RunFolder(Path("runs") / "_".join([_COPY, *source.parts[-3:]]))
    with naming(run.path):
        run.path.mkdir(parents=True, exist_ok=True)
        if not run.newest.exists():
            # The checkpoint last, and without modes: an installed package may be read-only.
            for file in sorted(source.iterdir(), key=lambda file: file.name == run.newest.name):
                shutil.copyfile(file, run.path / file.name)
        if run.newest.read_bytes() != (source / run.newest.name).read_bytes():
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
    wanted = re.sub(r"/(\d+)$", r"/s\1", name)
    names = {"/".join(path.parts[-3:]): path for path in folders}
    for pattern in (wanted, *(f"{setup}/{wanted}" for setup in (*USUAL_SETUPS, "*"))):
        if matching := [path for n, path in names.items() if fnmatch(f"{n}/", f"{pattern}/*")]:
            return matching
    raise UserError(f"{text}: no such trained policy; known: {', '.join(names)}")


def find_one(text: str) -> Path:
    """Returns the folder of the trained policy with a name and, among several, the lowest seed."""
    policies = find(text)
    recipes = sorted({"/".join(folder.parts[-3:-1]) for folder in policies})
    if len(recipes) > 1:
        raise UserError(f"{text} is ambiguous: {', '.join(recipes)}")
    return policies[0]


def _shipped() -> Path:
    return Path(str(files("emberlink.policies"))) / "pretrained"


def _order(folder: Path) -> tuple[str, str, int]:
    setup, method, seed = folder.parts[-3:]
    return setup, method, int(seed.removeprefix("s"))
