"""Tests that the reference lists everything that can be configured."""

from dataclasses import fields
from pathlib import Path

import pytest

from emberlink.comm import registry as communication
from emberlink.trainers.learners import registry as learners
from emberlink.trainers.sweep.executors import base as executors

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "configuration.md"
REGISTRIES = {"learner": learners, "comm": communication, "executor": executors}
KINDS = [(kind, name) for kind, registry in REGISTRIES.items() for name in registry.known()]


@pytest.mark.parametrize(("kind", "name"), KINDS)
def test_the_keys_of_everything_that_can_be_chosen_are_listed(kind, name):
    text = PAGE.read_text()
    listed = f"```{{configuration-keys}} {kind} {name}\n" in text
    assert listed == bool(fields(REGISTRIES[kind].find(name).config_type))
    if not listed:
        assert f"`{name}`" in text
