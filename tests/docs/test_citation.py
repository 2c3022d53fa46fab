"""Tests that the places that name the version agree, and that CITATION.cff is complete."""

import re
import tomllib
from pathlib import Path

import yaml

ROOT = Path(__file__).parents[2]
CITATION = yaml.safe_load((ROOT / "CITATION.cff").read_text())
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
KNOWN = {
    *("cff-version", "message", "title", "type", "version", "license"),
    *("authors", "abstract", "keywords", "references"),
}


def test_the_citation_has_all_that_a_reference_needs():
    assert CITATION.keys() - {"date-released"} == KNOWN
    assert CITATION["cff-version"] == "1.2.0"
    assert CITATION["type"] == "software"
    assert all(CITATION[key] for key in KNOWN)
    for work in (CITATION, *CITATION["references"]):
        assert work["title"]
        assert all(author.keys() == {"name"} for author in work["authors"])


def test_the_version_and_the_licence_are_those_of_the_package():
    assert CITATION["version"] == PROJECT["version"]
    assert CITATION["license"] == PROJECT["license"]


def test_the_changelog_begins_with_the_version_and_its_date():
    version, date = re.findall(r"^## (\S+), (.+)$", (ROOT / "CHANGELOG.md").read_text(), re.M)[0]
    assert version == PROJECT["version"]
    released = CITATION.get("date-released")
    assert date == (f"{released:%d %B %Y}" if released else "not released yet")


def test_the_paper_is_the_one_of_the_readme():
    (paper, _) = CITATION["references"]
    assert paper["title"] in " ".join((ROOT / "README.md").read_text().split())
