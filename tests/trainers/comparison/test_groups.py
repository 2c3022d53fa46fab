"""Tests which groups of a comparison are held against each other, and how they are named."""

import pytest
from synthetic_runs import write_run

from emberlink.trainers import compare
from emberlink.trainers.comparison.claims import CLAIMS
from emberlink.trainers.comparison.groups import by_value
from emberlink.trainers.comparison.rankings import Numbers, Ranking
from emberlink.trainers.comparison.report.page import lines
from emberlink.trainers.comparison.scripted import Scripted


def only(folder) -> Numbers:
    (section,) = compare([folder]).sections
    return section


def test_the_factors_are_those_of_the_paper():
    assert [(claim.measure, claim.factor) for claim in CLAIMS] == [
        ("coverage", 1.3),
        ("tracking_first", 1.4),
        ("tracking_last", 1.4),
        ("boundary_exits", 2.0),
    ]


def test_claims_compare_groups_in_which_the_same_was_changed(tmp_path):
    """Consensus with a batch of 64 is compared with independent with 64, not with the better 32."""
    sizes = {"learner.batch_size=64": 64, "learner.batch_size=32": 32}
    for setting, size in sizes.items():
        for method, coverage in (("consensus", 1.2 * size), ("independent", size)):
            name = f"{method}_{size}"
            learned = {"coverage": coverage}
            write_run(tmp_path, method, name=name, overrides=(setting,), learned=learned)
    write_run(tmp_path, "consensus", overrides=("learner.batch_size=16",), learned={"coverage": 90})
    write_run(tmp_path, "positional", overrides=("learner.batch_size=16",), name="p")
    write_run(tmp_path, "consensus", name="c", overrides=("learner.batch_size=8",))
    section = only(tmp_path)
    claims = [verdict for verdict in section.verdicts if verdict.measure == "coverage"]
    assert [(v.method, v.best_other) for v in claims] == [
        ("consensus (learner.batch_size=16)", "positional"),
        ("consensus (learner.batch_size=32)", "independent (learner.batch_size=32)"),
        ("consensus (learner.batch_size=64)", "independent (learner.batch_size=64)"),
    ]
    assert [v.ratio for v in claims[1:]] == pytest.approx([1.2, 1.2])
    (note,) = [note for note in section.notes if "no claims" in note]
    assert "consensus (learner.batch_size=8)" in note


def test_a_run_of_ones_own_is_compared_before_a_copy_of_the_packages(tmp_path):
    for name in ("mine", "pretrained_tuned_consensus_s0"):
        write_run(tmp_path, "consensus", name=name)
    comparison = compare([tmp_path])
    (section,) = comparison.sections
    (group,) = section.section.groups
    assert [run.path.name for run in group.runs] == ["mine"]
    (note,) = [note for note in comparison.notes if "trained twice" in note]
    assert f"{tmp_path}/mine is used" in note


def test_lines_after_the_last_episode_are_not_compared(tmp_path):
    for seed, episodes in enumerate((2, 3)):
        run = write_run(tmp_path, "consensus", seed, episodes=episodes)
        config = (run / "config.yaml").read_text()
        (run / "config.yaml").write_text(config.replace(f"episodes: {episodes}\n", "episodes: 2\n"))
    (group,) = only(tmp_path).section.groups
    assert [len(run.lines) for run in group.runs] == [2, 2]


def test_claims_do_not_depend_on_settings_of_communication(tmp_path):
    for seed, setting in enumerate(("comm.agree=true", "comm.agree=false", "env.radio.range=5")):
        write_run(tmp_path, "consensus", seed, overrides=(setting,))
    write_run(tmp_path, "independent", 0)
    claims = only(tmp_path).verdicts
    assert len({verdict.method for verdict in claims}) == 3
    assert {verdict.best_other for verdict in claims} == {"independent"}


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ({"a": "1", "b": "2"}, "2 for b; 1 for a"),
        ({"a": "1", "b": "2", "c": "1"}, "2 for b; 1 for a, c"),
        ({"a": "1", "b": "2", "c": "1", "d": "1", "e": "3"}, "2 for b; 3 for e; 1 for all others"),
    ],
)
def test_differences_are_told_by_value(values, told):
    assert by_value(values) == told


def test_a_setting_that_a_learner_lacks_is_no_difference(tmp_path):
    for seed, learner in enumerate(("ddpg", "ippo")):
        write_run(tmp_path, "consensus", seed, overrides=(f"learner={learner}",))
    notes = compare([tmp_path]).notes
    assert any("learner.name: ippo for consensus (learner=ippo" in note for note in notes)
    assert not any("learner.batch_size" in note for note in notes)


def test_the_settings_that_come_with_a_learner_do_not_name_a_group(tmp_path):
    for name, change in enumerate(("learner=mappo", "learner.clip=0.1", "learner=ddpg")):
        write_run(tmp_path, "consensus", name=f"{name}", overrides=("setup=strong", change))
    labels = [group.label for group in only(tmp_path).section.groups]
    assert labels == ["consensus", "consensus (learner.clip=0.1)", "consensus (learner=ddpg)"]


def test_a_policy_with_the_same_number_for_most_groups_names_the_others_only():
    few, most = Scripted(["a"], 1.0), Scripted(["b", "c", "d"], 2.0)
    ranking = Ranking("coverage", True, [], {"follow_target": [most, few]}, "")
    assert [line.name for line in lines(ranking)] == [
        "follow target (a)",
        "follow target (all others)",
    ]
