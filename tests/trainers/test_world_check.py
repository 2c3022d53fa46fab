"""Tests `emberlink world check`."""

import json

import numpy as np
import pytest
from rich.console import Console

from emberlink.envs.scenarios import fires_of
from emberlink.policies.scripted.base import SCRIPTED
from emberlink.trainers.cli import main
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.evaluation import evaluate
from emberlink.trainers.worlds import check
from emberlink.trainers.worlds.check import conditions

POLICIES = ("random_waypoints", "map_greedy_alone", "map_greedy_all", "oracle")
TINY = ("env.grid=[12,12]", "env.horizon=12", "env.num_uavs=2")


def made_up(coverage, ages=None):
    """Returns means of the needed policies with the given coverages and front ages."""
    ages = ages or [None] * 4
    return {
        policy: {"coverage": share} | ({} if age is None else {"front_age": age})
        for policy, share, age in zip(POLICIES, coverage, ages, strict=True)
    }


@pytest.mark.parametrize(
    ("coverage", "ages", "passes"),
    [
        ((50.0, 80.0, 90.0, 90.0), None, (True, True, True)),
        ((50.1, 80.0, 89.9, 89.9), None, (False, False, False)),
        ((10.0, 80.0, 80.0, 95.0), (60.0, 40.0, 36.0, 20.0), (True, True, True)),
        ((10.0, 80.0, 80.0, 95.0), (60.0, 40.0, 36.1, 20.0), (True, True, False)),
        ((10.0, 80.0, 95.0, 95.0), (60.0, 40.0, 44.0, 20.0), (True, True, True)),
    ],
)
def test_conditions_of_made_up_worlds(coverage, ages, passes):
    found = conditions(made_up(coverage, ages), "coverage")
    assert tuple(condition.passes for condition in found) == passes


def test_the_suite_is_the_worlds_that_evaluate_the_needed_policies(capsys):
    names = check.suite(Console(width=300))
    assert names == ["blackout", "front", "relay", "swarm"]
    notes = capsys.readouterr().out
    assert "note: file is left out: fire.path=null: a file is needed" in notes
    assert (
        "note: paper is left out: world paper: evaluation.scripted lacks map_greedy_alone" in notes
    )


def test_check_plays_on_validation_fires_as_an_evaluation_does(tmp_path):
    file = tmp_path / "out.json"
    arguments = ["world", "check", "front", *TINY, "--fires", "3", "--json", str(file)]
    status = main.main([*arguments, "--validation"])
    found = json.loads(file.read_text())["front"]
    assert found["passes"] == (status == 0) == all(c["passes"] for c in found["conditions"])
    config = resolve("independent", ["world=front", *TINY])
    fires = fires_of(config.fire).validation(3, (12, 12), 12)
    measured = evaluate.play_blocks(
        config,
        SCRIPTED.find("map_greedy"),
        fires,
        start_seed=evaluate.VALIDATION_START_SEED,
        block=3,
    )
    assert (found["split"], found["fires"]) == ("validation", 3)
    for name, values in measured.items():
        assert found["means"]["map_greedy"][name] == pytest.approx(np.mean(values), abs=6e-4)
    file.unlink()
    assert main.main(arguments) in (0, 1)
    again = json.loads(file.read_text())["front"]
    assert again["split"] == "test"
    assert again["means"] != found["means"]
