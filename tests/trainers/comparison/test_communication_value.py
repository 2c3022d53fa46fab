"""Tests the value of communication on numbers that were computed by hand."""

import json

import pytest
from synthetic_runs import evaluate_otherwise, write_run

from emberlink.policies.scripted.base import SCRIPTED
from emberlink.trainers.comparison.comparison import compare_runs
from emberlink.trainers.comparison.report import tables
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.evaluation.evaluate import evaluation_fires, play_blocks

OFF, FULL = "env.radio.range=0", "env.radio.range=inf"


def at_range(run, reach: float, **coverage) -> None:
    """Writes an evaluation of a run with another range; `coverage` is by policy."""
    evaluate_otherwise(run, {"range": reach, "loss": 0.0}, **coverage)


def values(*paths):
    """Returns the rows of the value of communication as dictionaries, None for missing numbers."""
    return json.loads(compare_runs(paths).to_json())["communication"]


def interval(row, name):
    return row[f"{name}_low"], row[f"{name}_high"]


def test_networks_evaluated_with_other_radios(tmp_path):
    for seed, more in ((0, 0.0), (1, 2.0)):
        run = write_run(tmp_path, seed=seed, learned={"coverage": [50.0 + more, 60, 70, 80]})
        at_range(run, 0.0, learned=[40.0 + more, 50, 60, 70])
        at_range(run, float("inf"), learned=[60.0 + more, 80, 90, 90])
    (row,) = values(tmp_path)
    assert (row["label"], row["measure"], row["radios"]) == ("consensus", "coverage", "evaluated")
    assert (row["none"], row["with_radio"], row["full"]) == (55.25, 65.25, 80.25)
    assert (row["gain"], interval(row, "gain")) == (10.0, (10.0, 10.0))  # 10 on each fire
    assert row["value"] == pytest.approx(10 / 25)
    low, high = interval(row, "value")
    # each fire gains 10 of 20, 30, 30 or 20, so that all resamples are within 1/3 and 1/2
    assert 1 / 3 - 1e-9 <= low < 0.4 < high <= 0.5


def test_networks_trained_with_other_radios(tmp_path):
    """The interval is over seeds and fires; one seed has none."""
    for override, coverage in (("", 60.0), (OFF, 50.0), (FULL, 70.0)):
        for seed in range(2):
            overrides = (override, "checkpoint_interval=9") if override else ()
            name = f"run{override}{seed}".replace("=", "_")
            learned = {"coverage": coverage + 2 * seed}
            write_run(tmp_path, seed=seed, name=name, overrides=overrides, learned=learned)
    write_run(tmp_path, name="other", overrides=("comm.agree=false",), learned={"coverage": 1.0})
    (row,) = values(tmp_path)
    assert (row["radios"], row["gain"], row["value"]) == ("retrained", 10.0, 0.5)
    assert interval(row, "gain") == (8.0, 12.0)
    one_seed = [tmp_path / f"run{override}0".replace("=", "_") for override in ("", OFF, FULL)]
    (row,) = values(*one_seed)
    assert (row["value"], interval(row, "gain"), interval(row, "value")) == (
        None,  # undetermined: another seed may have nothing to gain
        (None, None),
        (None, None),
    )


@pytest.mark.filterwarnings("error")
def test_a_resample_without_anything_to_gain_leaves_no_interval(tmp_path):
    """On the first of four fires there is none; one resample in 256 draws only this fire."""
    run = write_run(tmp_path, learned={"coverage": [55.0, 60.0, 60.0, 60.0]})
    at_range(run, 0.0, learned=[50.0] * 4)
    at_range(run, float("inf"), learned=[50.0, 70.0, 70.0, 70.0])
    (row,) = values(tmp_path)
    assert row["value"] == pytest.approx(35 / 60)
    assert interval(row, "value") == (None, None)


def test_a_value_is_undetermined_where_no_limits_may_gain_nothing(tmp_path):
    faded = ("env.radio.fade=true",)  # which loses nothing where the range is infinite
    run = write_run(tmp_path, learned={"coverage": [60.0, 60, 60, 60]}, overrides=faded)
    at_range(run, 0.0, learned=[50.0, 50, 50, 50])
    at_range(run, float("inf"), learned=[40.0, 80, 80, 45])
    (row,) = values(tmp_path)
    assert (row["full"], row["value"], interval(row, "value")) == (61.25, None, (None, None))
    (table,) = (t for t in tables(compare_runs([tmp_path]), row["section"]) if "gain" in t.title)
    assert table.rows["value"].tolist() == ["undetermined"]


def test_scripted_policies_have_a_value_for_each_radio(tmp_path):
    more = "env.radio.bandwidth=8", "env.radio.delay=5"
    for reach, middle, other in ((20, 58.0, ()), (5, 52.0, ()), (5, 51.0, more)):
        overrides = (f"env.radio.range={reach}", *other)
        write_run(
            tmp_path,
            name=f"r{reach}{len(other)}",
            scripted=covering(map_greedy_alone=50.0, map_greedy=middle, map_greedy_all=60.0),
            overrides=overrides,
        )
    found = {row["label"]: row["value"] for row in values(tmp_path)}
    few = {"map greedy, range 5, delay 5, 8 bytes": 0.1}
    assert found == {"map greedy, range 20": 0.8, "map greedy, range 5": 0.2} | few


def covering(**coverage: float):
    return {policy: {"coverage": value} for policy, value in coverage.items()}


def test_with_a_base_scripted_policies_need_the_other_radios(tmp_path):
    """Without messages to each other, UAVs of map_greedy_alone still report to the base."""
    own = {"map_greedy_alone": 70.0, "map_greedy": 80.0, "map_greedy_all": 90.0, "courier": 85.0}
    based = ("env.radio.range=10", "env.base=[0,0]")
    write_run(tmp_path / "one", scripted=covering(**own), overrides=based)
    assert not values(tmp_path / "one")
    run = write_run(tmp_path / "three", scripted=covering(**own), overrides=based)
    for reach, greedy, courier in ((0.0, 40.0, 45.0), (float("inf"), 90.0, 95.0)):
        at_range(run, reach, map_greedy=greedy, courier=courier)
    compared = compare_runs([tmp_path / "three"])
    found = compared.communication[compared.communication["radios"] == "scripted"]
    columns = ["label", "none", "with_radio", "full", "value"]
    assert [tuple(row) for row in found[columns].to_numpy()] == [
        ("map greedy", 40.0, 80.0, 90.0, 0.8),
        ("courier", 45.0, 85.0, 95.0, 0.8),
    ]
    assert not any("does not have the same" in note for note in compared.notes)


def test_without_a_base_map_greedy_plays_as_alone_and_as_all_with_the_other_radios():
    silent, all_hear = ["env.radio.range=0", "env.radio.bandwidth=16"], ["env.radio.range=.inf"]
    pairs = ("map_greedy_alone", silent, 0), ("map_greedy_all", all_hear, 2 * 20 * 20 + 8)
    for other, radio, sent in pairs:
        choices = ("world=front", "env.horizon=60", "env.grid=[20,20]", "env.num_uavs=3")
        world = resolve("independent", choices)
        changed = resolve("independent", [*choices, *radio])
        fires = evaluation_fires(world, 2)["front"]
        expected = play_blocks(world, SCRIPTED.find(other), fires, block=2)
        actual = play_blocks(changed, SCRIPTED.find("map_greedy"), fires, block=2)
        assert {k: v for k, v in actual.items() if k != "bytes_per_step"} == {
            k: v for k, v in expected.items() if k != "bytes_per_step"
        }
        assert expected["bytes_per_step"] == actual["bytes_per_step"] == [sent, sent]
