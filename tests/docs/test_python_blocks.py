"""Runs the Python of the documentation: the blocks of a page one after another."""

import re
from pathlib import Path

import pytest
from fire_files import Ellipses, raster_of, write_asc

ROOT = Path(__file__).parents[2]
PAGES = [
    page
    for page in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    if "```python\n" in page.read_text()  # the notebooks run when the site is built
]


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_the_blocks_of_a_page_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_asc(tmp_path / "ArrivalTime.asc", raster_of(Ellipses(), 240))
    names = {"__name__": "page"}
    for number, block in enumerate(re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)):
        exec(compile(block, f"{page.name}, block {number}", "exec"), names)


def test_there_are_blocks():
    assert {"README", "communication", "environment", "learners"} <= {page.stem for page in PAGES}
