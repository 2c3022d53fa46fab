"""Tests that imports run one way: envs <- comm <- trainers, envs <- policies <- trainers."""

import ast
import importlib
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = ("envs", "comm", "policies", "trainers", "configs")
ALLOWED = {
    "envs": {"envs", "configs"},
    "comm": {"comm", "envs"},
    "policies": {"policies", "envs"},
    "trainers": {"trainers", "comm", "policies", "envs", "configs"},
    "configs": {"configs"},
}


def imported(source: str, folder: str) -> set[str]:
    """Returns the folders of emberlink that a file of `folder` imports anywhere."""
    folders = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.level == 1:
            names = [f"emberlink.{folder}"]
        elif isinstance(node, ast.ImportFrom) and node.level > 1:
            names = [f"emberlink.{alias.name}" for alias in node.names]
            names = [f"emberlink.{node.module}"] if node.module else names
        elif isinstance(node, ast.ImportFrom):
            names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        else:
            continue
        folders |= {name.split(".")[1] for name in names if name.startswith("emberlink.")}
    return folders & set(FOLDERS)


@pytest.mark.parametrize("folder", FOLDERS)
def test_folders_import_in_one_direction(folder):
    files = sorted((ROOT / folder).rglob("*.py"))
    assert files
    crossing = {
        file.relative_to(ROOT).as_posix(): sorted(more)
        for file in files
        if (more := imported(file.read_text(), folder) - ALLOWED[folder])
    }
    assert crossing == {}


def test_every_form_of_import_is_detected():
    forms = {
        "import emberlink.comm.base": {"comm"},
        "from emberlink import trainers": {"trainers"},
        "from emberlink.trainers.build import make_env": {"trainers"},
        "def f():\n    from emberlink.policies import networks": {"policies"},
        "from .uav import move": {"envs"},
        "from ..comm import base": {"comm"},
        "import torch": set(),
    }
    for source, folders in forms.items():
        assert imported(source, "envs") == folders, source


LOADED = """
import sys
from collections import Counter
before = set(sys.modules)
import {module}
heavy = {{"torch", "torchrl", "tensordict", "hydra", "wandb", "matplotlib", "pydantic"}}
print(*sorted(heavy & (set(sys.modules) - before)))
"""


@pytest.mark.parametrize(
    "module",
    [
        "emberlink.trainers.cli.main",
        "emberlink.trainers",
        "emberlink.envs",
        "emberlink.envs.utils.errors",
    ],
)
def test_the_command_line_starts_without_torch(module):
    code = LOADED.format(module=module)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


def test_names_are_listed_without_torch():
    code = "from emberlink.trainers.cli.main import main; main(['list', 'methods', 'worlds'])"
    code += "; import sys; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "consensus" in done.stdout
    assert done.stdout.endswith("False\n")


EFFECTS = """
import random, sys, threading, numpy, rich.style, torch
import torchrl.envs, torchrl.collectors, torchrl.objectives
import torchrl.record.loggers
state = torch.get_rng_state(), random.getstate(), torch.get_num_threads()
threads, default = threading.active_count(), torch.get_default_dtype()
import emberlink.envs, emberlink.envs.pettingzoo, emberlink.comm.registry, emberlink.comm.consensus
import emberlink.policies.scripted.registry, emberlink.policies.networks.actor_critic
import emberlink.trainers.training.trainer
assert torch.equal(state[0], torch.get_rng_state())
assert state[1:] == (random.getstate(), torch.get_num_threads())
assert (threads, default) == (threading.active_count(), torch.get_default_dtype())
assert "scipy" not in sys.modules  # only for fires of files
"""


def test_imports_have_no_side_effects(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", EFFECTS], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (0, ""), done.stderr
    assert list(tmp_path.iterdir()) == []


ROOMS = [
    file.parent.relative_to(ROOT).as_posix()
    for folder in FOLDERS
    for file in sorted((ROOT / folder).rglob("*.py"))
    if file.name == "__init__.py"
]


@pytest.mark.parametrize("room", ROOMS)
def test_a_folder_says_what_it_is_for_and_its_public_names_exist(room):
    package = importlib.import_module("emberlink." + room.replace("/", "."))
    assert package.__doc__
    assert package.__doc__.strip().endswith(".")
    for name in getattr(package, "__all__", []):
        assert getattr(package, name) is not None
    with pytest.raises(AttributeError):
        package.no_such_name  # noqa: B018


def test_every_folder_with_code_is_a_package():
    folders = {file.parent for folder in FOLDERS for file in (ROOT / folder).rglob("*.py")}
    # comm has no __init__.py: it would hide Jupyter's package of that name in this folder.
    assert {folder.relative_to(ROOT).as_posix() for folder in folders} == {*ROOMS, "comm"}


SOURCES = [path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*.py"))]


def lines_of_functions(source: str) -> dict[str, int]:
    """Returns the lines of each function, from its `def` to its end."""
    functions = (
        node
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    )
    return {node.name: node.end_lineno - node.lineno + 1 for node in functions}


def test_files_and_functions_are_short():
    assert lines_of_functions("@one\ndef f():\n    def g():\n        pass\n\n    g()\n") == {
        "f": 5,
        "g": 2,
    }
    scripts = sorted((ROOT / "trainers/replay/web").glob("*.js"))
    texts = {path.relative_to(ROOT).as_posix(): path.read_text() for path in SOURCES + scripts}
    assert [name for name, text in texts.items() if len(text.splitlines()) > 300] == []
    long = [
        f"{name}: {function}"
        for name, text in texts.items()
        if name.endswith(".py")
        for function, lines in lines_of_functions(text).items()
        if lines > 50
    ]
    assert long == []


def test_folders_hold_few_files():
    """A folder has at most 12 files besides `__init__.py` and `__main__.py`."""
    files = [path for path in SOURCES if not path.name.startswith("__")]
    counts = Counter(path.parent.relative_to(ROOT).as_posix() for path in files)
    assert {folder: count for folder, count in counts.items() if count > 12} == {}
