"""Changes run folders and caches: links, pipes, bits and digits."""

import json
import os
import random
import re
import shutil
from pathlib import Path

import yaml
from children import METHODS, SMALL, Child
from ends import command

from emberlink.trainers.config.compose import flat

COMMANDS = (
    ["train", "resume=RUN", "episodes=3"],
    ["eval", "RUN"],
    ["render", "RUN", "--frames", "2"],
    ["compare", "RUN", "--output", "OUT"],
)
LONGEST = 300
"""seconds that a command may take"""
FREE = ("evaluation.", "episodes", "output", "device", "logger", "on_nan", "checkpoint_", "keep_")
"""keys of config.yaml that `eval RUN --fires 1` does not depend on, or how they begin"""


def finished(folder: Path, method: str) -> Path:
    """Returns a finished run of a method, trained once with a separate cache."""
    os.environ["EMBERLINK_CACHE"] = str(folder / "cache")
    output = folder / f"sound_{method}"
    if not output.exists():
        arguments = ["train", method, *SMALL, "episodes=2", "logger=csv", f"output={output}"]
        status, text = ended(arguments, folder / "training")
        assert status == 0, text
    (run,) = output.iterdir()
    return run


def ended(arguments: list[str], folder: Path) -> tuple[int, str]:
    """Returns status and output of a command, which must end within `LONGEST`."""
    child = Child(command(arguments), folder)
    try:
        child.wait_for(lambda: False, LONGEST)
    except TimeoutError:
        child.send(9)
    return child.end(), child.text()


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def planted_trial(folder: Path, draw: random.Random, *, pipes: bool) -> list[str]:
    """Puts links, pipes or devices at names of a run folder, and runs a command.

    Returns:
        The failures: a traceback, a blocked command, a change outside of the run folder.
    """
    run, home = folder / "run", folder / "home"
    shutil.copytree(finished(folder.parent, draw.choice(METHODS)), run)
    (home / "data").mkdir(parents=True)
    for name in ("thesis.txt", "data/coverage.csv", "data/step_000000001.safetensors"):
        (home / name).write_text(f"my {name}\n")
    before = contents(home)
    names = [*run.rglob("*"), *(run / name for name in ("lock", "rollbacks.jsonl", "wandb"))]
    for path in draw.sample(sorted(names), 3):
        if path.parent.is_dir() and path.parent.resolve().is_relative_to(run):
            plant(path, home, draw, pipes=pipes)
    arguments = [
        word.replace("RUN", str(run)).replace("OUT", str(folder / "out"))
        for word in draw.choice(COMMANDS)
    ]
    status, text = ended(arguments, folder / "child")
    failures = []
    if status not in (0, 2) or "Traceback" in text:
        failures.append(f"{arguments}: status {status}: {text}")
    if contents(home) != before:
        failures.append(f"{arguments}: has changed files outside of the run folder")
    shutil.rmtree(folder)
    return failures


def plant(path: Path, home: Path, draw: random.Random, *, pipes: bool) -> None:
    """Replaces a file or folder by a link into `home`, or by a pipe or a device."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    path.unlink(missing_ok=True)
    if pipes:
        kind = draw.choice(("pipe", "link to a pipe", "/dev/zero", "/dev/stdin"))
        if kind == "pipe":
            os.mkfifo(path)
        elif kind == "link to a pipe":
            target = path.with_name("a_pipe")
            if not target.exists():
                os.mkfifo(target)
            path.symlink_to(target.name)
        else:
            path.symlink_to(kind)
    elif draw.random() < 0.2:
        path.hardlink_to(home / "thesis.txt")
    else:
        path.symlink_to(home / draw.choice(("thesis.txt", "data", "new", "data/coverage.csv")))


def cache_trial(folder: Path, draw: random.Random) -> list[str]:
    """Changes a bit of a cached file; checks that an evaluation gives the same numbers."""
    run, cache = folder / "run", folder / "cache"
    shutil.copytree(finished(folder.parent, draw.choice(METHODS)), run)
    shutil.copytree(folder.parent / "cache", cache)
    file = draw.choice(sorted(cache.iterdir()))
    content = bytearray(file.read_bytes())
    place = draw.randrange(len(content))
    content[place] ^= 1 << draw.randrange(8)
    file.write_bytes(content)
    before = (run / "eval.json").read_bytes()
    os.environ["EMBERLINK_CACHE"] = str(cache)
    status, text = ended(["eval", str(run)], folder / "child")
    failures = []
    if status != 0 or (run / "eval.json").read_bytes() != before:
        failures.append(f"byte {place} of {file.name}: status {status}, other numbers, or {text}")
    shutil.rmtree(folder)
    return failures


def config_trial(folder: Path, draw: random.Random) -> list[str]:
    """Changes a digit of config.yaml; checks that it is refused, or does not change the numbers.

    A change of a setting of evaluations must be mentioned.
    """
    run = folder / "run"
    shutil.copytree(finished(folder.parent, draw.choice(METHODS)), run)
    text = (run / "config.yaml").read_text()
    digit = draw.choice(list(re.finditer(r"\d", text)))
    other = draw.choice([value for value in "0123456789" if value != digit[0]])
    changed = f"{text[: digit.start()]}{other}{text[digit.end() :]}"
    (run / "config.yaml").write_text(changed)
    old, new = flat(yaml.safe_load(text)), flat(yaml.safe_load(changed))
    keys = [key for key in old if old[key] != new[key]]
    before = (run / "eval.json").read_bytes()
    status, said = ended(["eval", str(run), "--fires", "1"], folder / "child")
    failures = []
    if status == 2:
        if said.count("\n") != 1 or "Traceback" in said:
            failures.append(f"{keys}: {said}")
        if (run / "eval.json").read_bytes() != before:
            failures.append(f"{keys}: refused, and eval.json was written")
    elif status == 0:
        numbers = json.loads((run / "eval.json").read_bytes())["results"]
        if (
            not all(key.startswith(FREE) for key in keys)
            or numbers != json.loads(before)["results"]
        ):
            failures.append(f"{keys}: accepted")
        if any(key.startswith("evaluation.") and f"note: {key} is " not in said for key in keys):
            failures.append(f"{keys}: not mentioned in {said}")
    else:
        failures.append(f"{keys}: status {status}: {said}")
    shutil.rmtree(folder)
    return failures
