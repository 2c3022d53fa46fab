"""Tests that the arms of the study differ in what UAVs exchange and in nothing else."""

import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import yaml

from emberlink.trainers.config.compose import differences, resolve

sys.path.append(str(Path(__file__).parents[2] / "docs" / "experiments"))
study, tables = import_module("study"), import_module("tables")
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


def test_tables_are_of_arms():
    known = yaml.safe_load((Path(tables.__file__).with_suffix(".yaml")).read_text())
    for name in ("study", "study_value"):
        for row in known[name]["rows"].values():
            for run in row.split()[:-1]:
                world, arm = run.removeprefix("study_").split("/")
                assert arm in {"_".join(parts) for parts in study.arms(world)}
    for world in study.WORLDS:
        shown = {row.split("@")[0] for row in known[f"study_{world}"]["rows"].values()}
        assert shown == {"_".join(parts) for parts in study.arms(world)}


def test_the_numbers_of_the_study_by_hand():
    """50, 60 and 75 on each fire, with little spread over the seeds."""
    spread = np.array([[0.0], [0.1], [0.2], [0.3], [0.4]])
    none, some, full = (np.full((5, 4), x) + spread for x in (50, 60, 75))
    value, ends = tables.gain([some, none, full], "coverage", "value")
    assert value == pytest.approx(0.4)
    assert 0.3 < ends[0] < 0.4 < ends[1] < 0.5
    assert np.isnan(tables.gain([some, none, none], "coverage", "value")[0])
    assert tables.rise([np.array([[0] * 12 + [10, 20, 30, 60]])], "")[0] == 45 - 15


def test_a_claim_without_one_of_the_methods_is_computed():
    runs = "strong/consensus strong/independent strong/positional strong/shared_memory"
    assert tables.cell("{}", f"ratio {runs} coverage 2").startswith("1.00 [")
    assert tables.cell("{}", "gain strong/consensus strong/nobody coverage 1") == ""


def test_p_values_are_corrected_for_all_comparisons():
    rows = {"a": ["1.0", "0.01"], "b": ["", ""], "c": ["2.0", "0.02"]}
    lines = tables.table({"gain": "", "p": ""}, rows, holm="p").splitlines()
    assert [line.split("|")[3].strip() for line in lines[2:]] == ["0.0300", "0.0400"]
