"""Tests that docs/architecture.md names files and rooms that exist, and leaves out no room."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docs" / "architecture.md").read_text()
FOLDERS = ("envs", "comm", "policies", "trainers", "configs")
NAMED = sorted(set(re.findall(r"`((?:envs|comm|policies|trainers|configs)/[\w/.]*)`", TEXT)))


@pytest.mark.parametrize("path", NAMED)
def test_a_path_that_is_named_exists(path):
    assert (ROOT / path).exists()


def test_every_room_is_named():
    rooms = {file.parent for folder in FOLDERS for file in (ROOT / folder).rglob("__init__.py")}
    names = {room.relative_to(ROOT).as_posix() for room in rooms}
    assert {name for name in names if f"{name}/" not in TEXT} == set()
