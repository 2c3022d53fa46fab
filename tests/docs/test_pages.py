"""Tests that the pages agree with the code and with each other, and runs their Python blocks."""

import re
import tomllib
from dataclasses import fields
from pathlib import Path
from pydoc import locate

import pytest
import tables
import yaml
from fire_files import Ellipses, raster_of, write_asc

from emberlink.comm.base import MODULES
from emberlink.trainers.learners.base import LEARNERS
from emberlink.trainers.sweep.executors.base import EXECUTORS

ROOT = Path(__file__).parents[2]
TEXTS = {
    page: page.read_text() for page in [ROOT / "README.md", *sorted(ROOT.glob("docs/**/*.md"))]
}
ROOMS = ("envs", "comm", "policies", "trainers", "configs")
FIGURE = re.compile(r"!\[[^\]]*\]\(([^)]+)\)")
BLOCK = re.compile(r"```python\n(.*?)```", re.DOTALL)


def test_architecture_names_every_room_and_file_and_nothing_else():
    text = TEXTS[ROOT / "docs" / "architecture.md"]
    for path in re.findall(rf"`((?:{'|'.join(ROOMS)})/[\w/.]*)`", text):
        assert (ROOT / path).exists(), path
    rooms = {file.parent for room in ROOMS for file in (ROOT / room).rglob("__init__.py")}
    names = {f"{room.relative_to(ROOT).as_posix()}/" for room in rooms}
    names |= {file.name for room in rooms for file in room.glob("*.py") if file.name[:2] != "__"}
    assert {name for name in names if name not in text} == set()


def test_the_version_the_licence_and_the_date_agree():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    version, date = re.findall(r"^## (\S+), (.+)$", (ROOT / "CHANGELOG.md").read_text(), re.M)[0]
    assert citation["version"] == project["version"] == version
    assert citation["license"] == project["license"]
    released = citation.get("date-released")
    assert date == (f"{released:%d %B %Y}" if released else "not released yet")


def test_a_command_stands_beside_each_figure():
    shown = "".join(TEXTS.values())
    assert [file for file in (ROOT / "docs/images").iterdir() if file.name not in shown] == []
    for page, text in TEXTS.items():
        blocks = text.split("\n\n")
        for block, after in zip(blocks, [*blocks[1:], ""], strict=True):
            for file in FIGURE.findall(block) if page.parent != ROOT else []:
                assert (page.parent / file).is_file()
                assert re.match(r"Made with `(emberlink|python|make) [^`]+`", after), file


@pytest.mark.slow
@pytest.mark.parametrize(
    "page",
    [page for page, text in TEXTS.items() if "<!-- table: " in text],
    ids=lambda page: page.stem,
)
def test_tables_are_those_of_the_data(page):
    assert tables.written(TEXTS[page]) == TEXTS[page]


@pytest.mark.slow
@pytest.mark.drawn
def test_figures_are_those_of_the_data():
    for name, figure in tables.figures().items():
        assert (ROOT / f"docs/images/{name}.svg").read_text() == tables.svg(figure), "make tables"


@pytest.mark.slow
@pytest.mark.parametrize(
    "page",
    # BenchMARL needs another version of torchrl: `make test-clients` runs that page.
    [page for page, text in TEXTS.items() if BLOCK.search(text) and page.stem != "benchmarl"],
    ids=lambda page: page.stem,
)
def test_the_blocks_of_a_page_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_asc(tmp_path / "ArrivalTime.asc", raster_of(Ellipses(), 240))
    names = {"__name__": "page"}
    for number, block in enumerate(BLOCK.findall(TEXTS[page])):
        exec(compile(block, f"{page.name}, block {number}", "exec"), names)


PLUGINS = {"learner": LEARNERS, "comm": MODULES, "executor": EXECUTORS}
KINDS = [(kind, name) for kind, plugins in PLUGINS.items() for name in plugins.known()]


@pytest.mark.parametrize(("kind", "name"), KINDS)
def test_the_keys_of_everything_that_can_be_chosen_are_listed(kind, name):
    text = TEXTS[ROOT / "docs" / "reference" / "configuration.md"]
    listed = f"```{{configuration-keys}} {kind} {name}\n" in text
    assert listed == bool(fields(PLUGINS[kind].find(name).config_type))
    assert listed or f"`{name}`" in text


def test_the_api_page_names_what_there_is():
    page = TEXTS[ROOT / "docs/reference/api.md"]
    module, missing = "", []
    for kind, name in re.findall(r"\.\. (currentmodule|auto\w+):: (\S+)", page):
        module = name if kind == "currentmodule" else module
        missing += [name] if not (locate(name) or locate(f"{module}.{name}")) else []
    assert missing == []


def test_no_line_is_a_comment():
    """MyST leaves out a line of text that begins with a percent sign, such as a wrapped `98 %`."""
    comment = re.compile(r"^\s*%.*", re.M)
    assert [line for text in TEXTS.values() for line in comment.findall(text)] == []
