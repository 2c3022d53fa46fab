"""Tests that the arms of the study differ in what UAVs exchange and in nothing else."""

import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from emberlink.trainers.config.compose import differences, resolve

sys.path.append(str(Path(__file__).parents[2] / "docs" / "experiments"))
study, study_tables = import_module("study"), import_module("study_tables")
EXCHANGED = ("method", "replay", "comm.", "policy.message", "env.radio.")


def training(world: str, observed: str, name: str, more: list[str]):
    method, *texts = [*study.settings(world, observed, name), *more]
    return resolve(method, texts)


@pytest.mark.parametrize("world", study.WORLDS)
def test_arms_differ_in_what_uavs_exchange(world):
    stages = {"vector": [study.OF_VECTOR], "map": [study.OF_IMITATION, study.OF_MAP]}
    for observed in study.ARMS[world]:
        for more in stages[observed]:
            first = training(world, observed, "none", more)
            assert (first.env.observation, first.policy.message) == (observed, "none")
            for name in study.ARMS[world][observed]:
                apart = differences(first, training(world, observed, name, more))
                assert [key for key in apart if not key.startswith(EXCHANGED)] == [], name


def test_planned_comparisons_are_of_arms():
    for world, *labels in study_tables.PLANNED:
        assert {*labels} <= {"_".join(arm) for arm in study.arms(world)}
    names = {"_".join(arm) for arm in study.arms("front")}
    assert {*study_tables.UNLIMITED} <= names


def test_the_value_of_communication_by_hand():
    """50, 60 and 75 on each fire, with little spread over the seeds."""
    arms = [
        np.full((5, 4), x) + np.array([[0.0], [0.1], [0.2], [0.3], [0.4]]) for x in (50, 60, 75)
    ]
    assert study_tables.value_of_communication(*arms).startswith("0.40 [0.3")
    assert study_tables.value_of_communication(arms[0], arms[1], arms[0]) == "undetermined"
    lines = [{"front/coverage": x} for x in (0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 10, 20, 30, 60)]
    assert study_tables.rise_at_the_end(lines, "coverage") == 45 - 15
