"""Tests `emberlink world check`."""

import json

import numpy as np
import pytest
from rich.console import Console

from emberlink.envs import metrics
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


def made_up_play(coverage, age=30.0):
    """Returns a replacement of `played` with made-up measures of two fires."""
    shares = dict(zip(POLICIES, coverage, strict=True))

    def played(config, policy, *, fires, split, report=None):
        values = {name: [0.0, 0.0] for name in metrics.names(config.env)}
        share = shares.get(policy, 60.0)
        return values | {"coverage": [share - 1, share + 1], "front_age": [age, age]}

    return played


@pytest.mark.parametrize(("oracle", "status"), [(90.0, 0), (89.0, 1)])
def test_check_prints_figure_and_bound_and_ends_with_a_status(
    oracle, status, monkeypatch, capsys, tmp_path
):
    monkeypatch.setattr(check, "played", made_up_play((30.0, 70.0, 81.0, oracle)))
    file = tmp_path / "out.json"
    assert main.main(["world", "check", "front", "--json", str(file)]) == status
    out = capsys.readouterr().out
    assert "world front: means of 100 test fires" in out
    assert "pass: random_waypoints: coverage, % 30.0; at most 50" in out
    verdict = "FAIL" if status else "pass"
    assert f"{verdict}: oracle: coverage, % {oracle}; at least 90" in out
    gains = "coverage, points 11.0; front_age, % less 0.0; one of them at least 10"
    assert f"pass: map_greedy_all against map_greedy_alone: {gains}" in out
    written = json.loads(file.read_text())["front"]
    assert written["passes"] == (status == 0)
    assert written["means"]["oracle"]["coverage"] == oracle
    assert [condition["passes"] for condition in written["conditions"]] == [True, not status, True]


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
    assert main.main([*arguments, "--validation"]) in (0, 1)
    found = json.loads(file.read_text())["front"]
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


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["mars"], "world 'mars' is not known; known: blackout, file"),
        (["front", "evaluation.scripted=[oracle]"], "front: evaluation.scripted lacks random_way"),
        (["front", "evaluation.headline=front_age"], "front_age is not a share in %; known: cov"),
        (["world=front"], "the worlds are given without a key"),
        (["front", "--json", "out.txt"], "must end in .json"),
    ],
)
def test_bad_input_of_check(arguments, message, capsys):
    assert main.main(["world", "check", *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
