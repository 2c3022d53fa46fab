"""Tests the value of communication on numbers that were computed by hand."""

import json
import warnings

import numpy as np
import pytest
from synthetic_runs import read_evaluation, write_run

from emberlink.policies.scripted.registry import SCRIPTED
from emberlink.trainers.cli import main
from emberlink.trainers.comparison import bootstrap
from emberlink.trainers.comparison.results import compare_runs
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.evaluation.evaluate import evaluation_fires, play_blocks

OFF, FULL = "env.radio.range=0", "env.radio.range=inf"


def evaluate_otherwise(run, reach: float, coverage: list[float]) -> None:
    """Writes an evaluation of a run's networks with another range."""
    content = read_evaluation(run)
    content["environment"] = {"radio": {"range": reach, "loss": 0.0}}
    content["results"]["huygens"]["learned"]["coverage"] = coverage
    (run / f"eval_env.radio.range={reach}.json").write_text(json.dumps(content))


def test_networks_evaluated_with_other_radios(tmp_path, capsys):
    for seed, more in ((0, 0.0), (1, 2.0)):
        run = write_run(tmp_path, seed=seed, learned={"coverage": [50.0 + more, 60, 70, 80]})
        evaluate_otherwise(run, 0.0, [40.0 + more, 50, 60, 70])
        evaluate_otherwise(run, float("inf"), [60.0 + more, 80, 90, 90])
    (value,) = compare_runs([tmp_path]).sections[0].communication
    assert (value.policy, value.measure, value.how) == ("consensus", "coverage", "evaluated")
    assert (value.none, value.with_radio, value.full) == (55.25, 65.25, 80.25)
    assert (value.gain, value.gain_interval) == (10.0, (10.0, 10.0))  # 10 on each fire
    assert value.value == pytest.approx(10 / 25)
    assert value.interval is not None
    low, high = value.interval
    # each fire gains 10 of 20, 30, 30 or 20, so that all resamples are within 1/3 and 1/2
    assert 1 / 3 <= low < 0.4 < high <= 0.5
    assert main.main(["compare", str(tmp_path), "--output", str(tmp_path / "out")]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "the value of communication, by coverage" in said
    assert "consensus evaluated 55.2 65.2 80.2 10.00 [10.00, 10.00] 0.40 [" in said
    assert "huygens" in said.partition("the value of communication")[2]
    page = (tmp_path / "out" / "compare.html").read_text()
    table = page.partition("The value of communication")[2].partition("</table>")[0]
    assert "<td>huygens</td></tr>" in table
    (section,) = json.loads((tmp_path / "out" / "compare.json").read_text())["setups"]
    assert section["communication"][0]["value"] == pytest.approx(0.4)
    assert section["communication"][0]["gain"] == 10.0


def test_the_gain_is_paired_by_fire(tmp_path):
    run = write_run(tmp_path, learned={"coverage": [50.0, 60, 70, 80]})
    evaluate_otherwise(run, 0.0, [49.0, 59, 69, 79.0])  # fires differ by 10, the radios by 1
    evaluate_otherwise(run, float("inf"), [49.0, 59, 69, 79.0])
    (value,) = compare_runs([tmp_path]).sections[0].communication
    assert (value.gain, value.gain_interval) == (1.0, (1.0, 1.0))
    assert (value.value, value.interval) == (None, None)


def test_without_an_evaluation_without_limits_there_is_a_gain_and_no_value(tmp_path, capsys):
    run = write_run(tmp_path, learned={"coverage": [50.0, 60, 70, 80]})
    assert not compare_runs([tmp_path]).sections[0].communication
    evaluate_otherwise(run, 0.0, [48.0, 58, 68, 78])
    write_run(tmp_path, name="off", overrides=(OFF,), learned={"coverage": [49.0, 59, 69, 79]})
    retrained, evaluated = sorted(
        compare_runs([tmp_path]).sections[0].communication, key=lambda value: value.gain
    )
    for value, how, none in ((retrained, "retrained", 64.0), (evaluated, "evaluated", 63.0)):
        assert (value.how, value.none, value.with_radio, value.full) == (how, none, 65.0, None)
        assert value.gain_interval == (65.0 - none, 65.0 - none)
        assert (value.value, value.interval) == (None, None)
    assert main.main(["compare", str(tmp_path), "--output", str(tmp_path / "out")]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "consensus evaluated 63.0 65.0 - 2.00 [2.00, 2.00] - -" in said
    (section,) = json.loads((tmp_path / "out" / "compare.json").read_text())["setups"]
    assert [worth["full"] for worth in section["communication"]] == [None, None]


def test_networks_trained_with_other_radios(tmp_path):
    for override, coverage in (("", 60.0), (OFF, 50.0), (FULL, 70.0)):
        overrides = (override,) if override else ()
        name = f"run{override}".replace("=", "_")
        write_run(tmp_path, name=name, overrides=overrides, learned={"coverage": coverage})
    write_run(tmp_path, name="other", overrides=("comm.agree=false",), learned={"coverage": 1.0})
    (value,) = compare_runs([tmp_path]).sections[0].communication
    assert (value.how, value.value) == ("retrained", 0.5)
    assert value.interval == (0.5, 0.5)


def test_settings_without_effect_on_training_do_not_part_the_radios(tmp_path):
    for override, coverage in ((OFF, 50.0), ("", 60.0), (FULL, 70.0)):
        more = () if not override else (override, "keep_checkpoints=9", "logger=csv")
        name = f"run{override}".replace("=", "_")
        write_run(tmp_path, name=name, overrides=more, learned={"coverage": coverage})
    (value,) = compare_runs([tmp_path]).sections[0].communication
    assert (value.how, value.value) == ("retrained", 0.5)


def test_a_radio_with_little_bandwidth_has_limits(tmp_path):
    free, narrow = (FULL,), (FULL, "env.radio.bandwidth=8")
    for name, overrides, coverage in (
        ("off", (OFF,), 50.0),
        ("a", narrow, 60.0),
        ("b", free, 70.0),
    ):
        write_run(tmp_path, name=name, overrides=overrides, learned={"coverage": coverage})
    (value,) = compare_runs([tmp_path]).sections[0].communication
    assert (value.how, value.value) == ("retrained", 0.5)


def test_scripted_policies_have_a_value_for_each_radio(tmp_path):
    names = ("map_greedy_alone", "map_greedy", "map_greedy_all")
    more = "env.radio.bandwidth=8"  # which scripted policies ignore
    for reach, middle, other in ((20, 58.0, ()), (5, 52.0, ()), (5, 52.0, (more,))):
        overrides = (f"env.radio.range={reach}", *other)
        name = f"r{reach}{len(other)}"
        run = write_run(tmp_path, name=name, scripted=names, overrides=overrides)
        content = read_evaluation(run)
        for name, coverage in zip(names, (50.0, middle, 60.0), strict=True):
            content["results"]["huygens"][name]["coverage"] = [coverage] * 4
        (run / "eval.json").write_text(json.dumps(content))
    values = {v.policy: v.value for v in compare_runs([tmp_path]).sections[0].communication}
    assert values == {"map_greedy, range 20.0": 0.8, "map_greedy, range 5.0": 0.2}


def test_nothing_to_gain_has_no_value(tmp_path):
    run = write_run(tmp_path, learned={"coverage": [50.0, 60, 70, 80]})
    evaluate_otherwise(run, 0.0, [40.0, 50, 60, 70])
    evaluate_otherwise(run, float("inf"), [40.0, 50, 60, 70])
    (value,) = compare_runs([tmp_path]).sections[0].communication
    assert (value.value, value.interval) == (None, None)


def test_scripted_policies_have_a_value(tmp_path):
    names = ("map_greedy_alone", "map_greedy", "map_greedy_all")
    run = write_run(tmp_path, scripted=names)
    content = read_evaluation(run)
    for name, coverage in zip(names, (50.0, 55.0, 60.0), strict=True):
        content["results"]["huygens"][name]["coverage"] = [coverage] * 4
    (run / "eval.json").write_text(json.dumps(content))
    (value,) = compare_runs([tmp_path]).sections[0].communication
    assert (value.policy, value.how, value.value) == ("map_greedy", "scripted", 0.5)


def scripted_run(folder, base, results: dict[str, dict[str, float]]):
    """Writes a run with evaluations of scripted policies: file name -> policy -> coverage."""
    names = list(dict.fromkeys(name for played in results.values() for name in played))
    overrides = () if base is None else (f"env.base={base}",)
    run = write_run(folder, scripted=names, overrides=("env.radio.range=10", *overrides))
    content = read_evaluation(run)
    for name, played in results.items():
        for policy, coverage in played.items():
            content["results"]["huygens"][policy]["coverage"] = [coverage] * 4
        if name != "eval.json":
            reach = float(name.removeprefix("eval_env.radio.range=").removesuffix(".json"))
            content["environment"] = {"radio": {"range": reach, "loss": 0.0}}
        (run / name).write_text(json.dumps(content))


def test_with_a_base_scripted_policies_need_the_other_radios(tmp_path):
    """Without messages to each other, UAVs of map_greedy_alone still report to the base."""
    own = {"map_greedy_alone": 70.0, "map_greedy": 80.0, "map_greedy_all": 90.0, "courier": 85.0}
    scripted_run(tmp_path / "one", [0, 0], {"eval.json": own})
    assert compare_runs([tmp_path / "one"]).sections[0].communication == []
    off, full = ({**own, "map_greedy": a, "courier": b} for a, b in ((40.0, 45.0), (90.0, 95.0)))
    results = {"eval.json": own, f"eval_{OFF}.json": off, f"eval_{FULL}.json": full}
    scripted_run(tmp_path / "three", [0, 0], results)
    compared = compare_runs([tmp_path / "three"])
    values = [v for v in compared.sections[0].communication if v.how == "scripted"]
    assert [(v.policy, v.none, v.with_radio, v.full, v.value) for v in values] == [
        ("map_greedy", 40.0, 80.0, 90.0, 0.8),
        ("courier", 45.0, 85.0, 95.0, 0.8),
    ]
    assert not [note for note in compared.notes if "does not have the same" in note]


def test_the_other_radios_of_scripted_policies_are_those_of_the_same_team(tmp_path):
    own = {"map_greedy": 80.0, "courier": 85.0}
    scripted_run(tmp_path, [0, 0], {"eval.json": own})
    for reach, name in (("0", "off"), ("inf", "full")):
        overrides = ("env.base=[0,0]", f"env.radio.range={reach}", "env.num_uavs=3")
        write_run(tmp_path, name=name, scripted=tuple(own), overrides=overrides)
    assert compare_runs([tmp_path]).sections[0].communication == []


def test_groups_with_other_headlines_are_compared(tmp_path):
    ages = ("env.measures=all", "evaluation.headline=front_age")
    learned = {"front_age": 30.0, "front_age_p95": 60.0, "bytes_per_step": 9.0}
    write_run(tmp_path, overrides=ages, learned=learned)
    for override, coverage in ((OFF, 50.0), ("env.radio.range=10", 60.0), (FULL, 70.0)):
        name = f"run{override}".replace("=", "_")
        more = {"learned": {"coverage": coverage}, "overrides": (override,)}
        write_run(tmp_path, "independent", name=name, **more)
    (value,) = compare_runs([tmp_path]).sections[0].communication
    assert (value.policy, value.measure, value.value) == ("independent", "coverage", 0.5)


def test_a_resample_without_anything_to_gain_leaves_no_interval(tmp_path):
    """On the first of four fires there is none; one resample in 256 draws only this fire."""
    run = write_run(tmp_path, learned={"coverage": [55.0, 60.0, 60.0, 60.0]})
    evaluate_otherwise(run, 0.0, [50.0, 50.0, 50.0, 50.0])
    evaluate_otherwise(run, float("inf"), [50.0, 70.0, 70.0, 70.0])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        (value,) = compare_runs([tmp_path]).sections[0].communication
    assert (value.value, value.interval) == (35 / 60, None)


def test_without_a_base_map_greedy_plays_as_alone_and_as_all_with_the_other_radios():
    pairs = (("map_greedy_alone", "0"), ("map_greedy_all", ".inf"))
    for other, reach in pairs:
        choices = ("world=front", "env.horizon=60", "env.grid=[20,20]", "env.num_uavs=3")
        world = resolve("independent", choices)
        changed = resolve("independent", [*choices, f"env.radio.range={reach}"])
        fires = evaluation_fires(world, 2)["front"]
        expected = play_blocks(world, SCRIPTED[other], fires, block=2)
        actual = play_blocks(changed, SCRIPTED["map_greedy"], fires, block=2)
        assert {k: v for k, v in actual.items() if k != "bytes_per_step"} == {
            k: v for k, v in expected.items() if k != "bytes_per_step"
        }
        sent = 0.0 if reach == "0" else 2 * 20 * 20 + 8
        assert expected["bytes_per_step"] == actual["bytes_per_step"] == [sent, sent]


def test_the_paired_interval_draws_fires_together():
    first = np.array([1.0, 2.0, 3.0, 4.0])

    def difference(a, b, axis=-1):
        return a.mean(axis) - b.mean(axis)

    assert bootstrap.paired_interval(difference, first, first + 1) == (-1.0, -1.0)
    assert bootstrap.paired_interval(difference, first[:1], first[:1]) is None
