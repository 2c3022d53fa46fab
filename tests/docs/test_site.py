"""Tests what the documentation site shows: generated tables, links, formulas; nothing twice."""

import re
from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import pytest

from emberlink.envs import metrics

DOCS = Path(__file__).parents[2] / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
CODE = re.compile(r"\[\.\.\.|->|int64|float32|\bbool\b|\bTensor\b|\bNone\b|Undefined|e[+-]\d\d")


@pytest.fixture
def reference(monkeypatch):
    monkeypatch.syspath_prepend(str(DOCS / "site"))
    import reference_pages

    return reference_pages


def test_measures_are_described_in_words(reference):
    text = reference.Measures.text(None)
    assert [row.split("`")[1] for row in text.splitlines()[2:]] == list(metrics.ALL)
    assert CODE.findall(text) == []
    assert all(len(row.split("|")[3].split()) > 5 for row in text.splitlines()[2:])


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        ("run", ""),
        *(("learner", name) for name in ("ddpg", "td3", "ippo", "mappo")),
        ("comm", "consensus"),
        *(("fire", kind) for kind in ("spread", "reaction", "file")),
        *(("executor", name) for name in ("local", "submitit", "ray")),
    ],
)
def test_keys_are_described_in_words(kind, name, reference):
    rows = [" | ".join(row) for row in reference._rows(kind, name)]
    assert rows
    assert [row for row in rows if CODE.search(row)] == []


def test_a_range_is_written_out(reference):
    rows = {row[0]: row for row in reference._rows("run", "")}
    assert rows["`env.grid`"][2].endswith("; 2 values, each whole number ≥ 8 and ≤ 256")
    assert rows["`env.horizon`"][2].endswith("; whole number ≥ 1 and ≤ 1,000,000")
    assert rows["`env.reward.exit`"][2].endswith("; number")
    rows = {row[0]: row for row in reference._rows("executor", "ray")}
    assert rows["`executor.resources`"][1] == "`{}`"


def test_keys_and_measures_are_tabulated_in_the_reference_only():
    tables = r"^\| (?:key|option|measure|`\w+Config`) \| (?:default|definition|better)"
    assert [page.name for page in PAGES if re.search(tables, page.read_text(), re.M)] == []


def test_no_line_is_a_comment():
    """MyST leaves out a line of text that begins with a percent sign, such as a wrapped `98 %`."""
    comment = re.compile(r"^\s*%.*", re.M)
    assert [line for page in PAGES for line in comment.findall(page.read_text())] == []


def test_a_figure_stands_on_one_page():
    shown = Counter(name for page in PAGES for name in FIGURE.findall(page.read_text()))
    assert [name for name, count in shown.items() if count > 1] == []


FIGURE = re.compile(r"!\[[^\]]*\]\((?:\.\./)*([^)]+)\)")


@pytest.mark.parametrize(
    ("page", "link", "shown"),
    [
        ("rendering", "[a page](replay.html)", '<a href="replay.html">a page</a>'),
        ("tutorial/x", "[a page](../replay.html#t=9)", '<a href="../replay.html#t=9">a page</a>'),
        ("setups", "[all keys](../configs/base.yaml)", "all keys (`configs/base.yaml`)"),
        ("setups", "[fire](fire.md#seeds)", "[fire](fire.md#seeds)"),
    ],
)
def test_copied_pages_are_opened_and_other_files_are_named(page, link, shown, monkeypatch):
    monkeypatch.syspath_prepend(str(DOCS / "site"))
    from source_links import _rewrite

    app = SimpleNamespace(srcdir=DOCS, config=SimpleNamespace(html_extra_path=["replay.html"]))
    source = [link]
    _rewrite(app, page, source)
    assert source == [shown]


def test_formulas_can_be_drawn_without_the_network():
    from docutils.utils.math.latex2mathml import tex2mathml

    texts = [page.read_text() for page in PAGES]
    formulas = [formula for text in texts for formula in re.findall(r"\$\$(.+?)\$\$", text, re.S)]
    assert formulas
    assert all("<mfrac>" in tex2mathml(formula, as_block=True) for formula in formulas)
