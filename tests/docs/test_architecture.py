"""Tests that docs/architecture.md names the folders and files that there are."""

import re
import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docs" / "architecture.md").read_text()
HAND_WRITTEN = TEXT.split("## Every file")[0]
FIGURE = TEXT.split("```")[1]
FOLDERS = ("envs", "comm", "policies", "trainers", "configs")
INSIDE = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*.*")]
FILES = sorted(set(re.findall(r"`([\w/]+\.(?:py|js|html|css))`", HAND_WRITTEN)) - {"NAME.py"})


@pytest.mark.parametrize("file", [file for file in FILES if "NAME" not in file])
def test_a_file_that_is_named_exists(file):
    assert any(path.as_posix().endswith(f"/{file}") for path in INSIDE)


@pytest.mark.parametrize("folder", ["envs", "policies", "trainers"])
def test_every_room_is_in_the_figure(folder):
    rooms = [path.parent.name for path in (ROOT / folder).glob("*/__init__.py")]
    files = [path.name for path in (ROOT / folder).glob("*.py") if path.name != "__init__.py"]
    missing = [room for room in rooms if not re.search(rf"\b{room}/", FIGURE)]
    assert missing == []
    assert [file for file in files if file not in FIGURE] == []


@pytest.mark.parametrize(("file", "name"), re.findall(r"`([\w/]+\.py)` \(`(\w+)`", TEXT))
def test_a_function_that_is_named_is_in_its_file(file, name):
    (path,) = [path for path in INSIDE if path.as_posix().endswith(f"/{file}")]
    assert re.search(rf"(def|class) {name}\b", path.read_text()), (file, name)


def test_every_file_is_listed_with_its_first_sentence():
    script = runpy.run_path(str(ROOT / "docs" / "site" / "file_list.py"))
    assert script["page"]() == TEXT, "run: python docs/site/file_list.py"
