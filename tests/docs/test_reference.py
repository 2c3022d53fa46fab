"""Tests that the reference lists everything that can be configured."""

from dataclasses import fields
from pathlib import Path

import pytest

from emberlink.comm.base import MODULES
from emberlink.trainers.learners.base import LEARNERS
from emberlink.trainers.sweep.executors.base import EXECUTORS

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "configuration.md"
PLUGINS = {"learner": LEARNERS, "comm": MODULES, "executor": EXECUTORS}
KINDS = [(kind, name) for kind, plugins in PLUGINS.items() for name in plugins.known()]


@pytest.mark.parametrize(("kind", "name"), KINDS)
def test_the_keys_of_everything_that_can_be_chosen_are_listed(kind, name):
    text = PAGE.read_text()
    listed = f"```{{configuration-keys}} {kind} {name}\n" in text
    assert listed == bool(fields(PLUGINS[kind].find(name).config_type))
    if not listed:
        assert f"`{name}`" in text
