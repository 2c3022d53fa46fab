"""Tests what importing costs and changes; `make lint` tests the direction of imports."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = ("envs", "comm", "policies", "trainers", "configs")

LOADED = """
import sys
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
import emberlink.envs, emberlink.envs.pettingzoo, emberlink.comm.consensus
import emberlink.policies.scripted.base, emberlink.policies.networks.actor_critic
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


SOURCES = [path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*.py"))]


def test_no_file_is_over_500_lines():
    long = [path for path in SOURCES if len(path.read_text().splitlines()) > 500]
    assert [path.relative_to(ROOT).as_posix() for path in long] == []
