"""Checks that the documentation says how each of its figures was made."""

import re
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[2] / "docs"
FIGURE = re.compile(r"!\[[^\]]*\]\(([^)]+)\)")
PAGES = [page for page in sorted(DOCS.rglob("*.md")) if FIGURE.search(page.read_text())]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_command_stands_beside_each_figure(page):
    blocks = page.read_text().split("\n\n")
    for block, after in zip(blocks, [*blocks[1:], ""], strict=True):
        for file in FIGURE.findall(block):
            assert (page.parent / file).is_file()
            assert re.match(r"Made with `(emberlink|python) [^`]+`", after), file


def test_every_figure_is_shown_somewhere():
    texts = "".join(page.read_text() for page in [DOCS.parent / "README.md", *PAGES])
    assert [file.name for file in (DOCS / "images").iterdir() if file.name not in texts] == []
