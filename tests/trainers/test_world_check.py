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


@pytest.mark.parametrize(
    ("coverage", "passes"),
    [
        ((46.0, 72.0, 80.0, 92.0), (True, True, True)),  # 50 %, 111 %, 115 %
        ((46.1, 72.8, 80.1, 92.0), (False, True, False)),
        ((46.0, 73.0, 80.0, 92.0), (True, False, True)),
        ((80.5, 60.0, 70.0, 92.0), (False, True, False)),  # the best is random
    ],
)
def test_conditions_of_made_up_worlds(coverage, passes):
    means = {policy: {"coverage": c} for policy, c in zip(POLICIES, coverage, strict=True)}
    found = conditions(means, "coverage")
    assert tuple(condition.passes for condition in found) == passes


def test_the_suite_is_the_worlds_that_evaluate_the_needed_policies(capsys):
    names = check.suite(Console(width=300))
    assert names == ["blackout", "front", "relay", "swarm"]
    notes = capsys.readouterr().out
    assert all(f"{name} is left out" in notes for name in ("file", "paper"))


def test_check_plays_on_validation_fires_as_an_evaluation_does(tmp_path):
    file = tmp_path / "out.json"
    arguments = ["world", "check", "front", *TINY, "--fires", "3", "--json", str(file)]
    status = main.main([*arguments, "--validation"])
    found = json.loads(file.read_text())["front"]
    assert found["passes"] == (status == 0) == all(c["passes"] for c in found["conditions"])
    config = resolve("independent", ["world=front", *TINY])
    fires = fires_of(config.fire).fires("validation", 3, (12, 12), 12)
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
