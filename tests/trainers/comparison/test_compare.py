"""Tests `emberlink compare`: its grouping of runs, its numbers and its page."""

import errno
import html
import html.parser
import json
import os
import re
import shutil
from importlib.resources import files
from itertools import permutations
from pathlib import Path
from urllib.parse import unquote, unquote_to_bytes

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from matplotlib.axes import Axes
from synthetic_runs import read_evaluation, write_evaluation, write_run
from unpack_replay import data_of

from emberlink.envs import metrics
from emberlink.envs.utils.errors import UserError
from emberlink.trainers import compare
from emberlink.trainers.cli import main
from emberlink.trainers.comparison import claims
from emberlink.trainers.comparison.groups import gather
from emberlink.trainers.comparison.rankings import numbers
from emberlink.trainers.comparison.report import chapters, plots
from emberlink.trainers.comparison.runs import Run, find, read
from emberlink.trainers.comparison.scripted import Scripted
from emberlink.trainers.config.compose import resolve, to_values
from emberlink.trainers.runs.run_folder import RunFolder, without_time_and_seed
from emberlink.trainers.terminal.console import OutputError

METHODS = ("consensus", "independent", "positional", "shared_memory")


def gathered(*paths):
    """Returns the sections and notes of run folders."""
    runs = [read(path) for path in find(paths)]
    assert all(isinstance(run, Run) for run in runs), runs
    return gather(runs)


def only(*paths):
    """Returns the numbers of the only section."""
    (section,), _ = gathered(*paths)
    return numbers(section)


def ranking(section, measure, fire="huygens"):
    return next(r for r in section.fires[fire] if r.measure == measure)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Writes runs of two methods with three and two seeds."""
    folder = tmp_path_factory.mktemp("runs")
    for seed, coverage in enumerate((50, 70, 60)):
        write_run(folder, "consensus", seed, learned={"coverage": [coverage - 5, coverage + 5] * 2})
    for seed, coverage in enumerate((40, 65)):
        write_run(folder, "independent", seed, learned={"coverage": coverage})
    return folder


def test_numbers_by_hand(runs):
    section = only(runs)
    first, second = ranking(section, "coverage").rows
    assert (first.method, first.seeds, first.values) == ("consensus", [0, 1, 2], [50, 70, 60])
    assert (first.iqm, first.interval) == (60, (50, 70))
    # 50 is above 40, 70 above both, 60 above 40: 4 of 6 pairs.
    assert (first.next, first.probability_of_improvement) == ("independent", pytest.approx(4 / 6))
    assert (second.iqm, second.interval, second.next) == (52.5, (40, 65), None)
    assert (second.probability_of_improvement, second.probability_interval) == (None, None)
    (claim,) = (v for v in section.verdicts if v.measure == "coverage")
    assert claim.ratio == pytest.approx(60 / 52.5)
    assert claim.interval == pytest.approx((50 / 65, 70 / 40), abs=0.1)
    assert (claim.best_other, claim.verdict, claim.fewest_seeds) == ("independent", "undecided", 2)


def test_measures_where_lower_is_better(tmp_path):
    for seed in range(3):
        write_run(tmp_path, "consensus", seed, learned={"tracking_first": 10 + seed})
        write_run(tmp_path, "positional", seed, learned={"tracking_first": 30 + seed})
    section = only(tmp_path)
    first, last = ranking(section, "tracking_first").rows
    assert (first.method, first.probability_of_improvement) == ("consensus", 1)
    assert last.method == "positional"
    (claim,) = (v for v in section.verdicts if v.measure == "tracking_first")
    assert claim.ratio == pytest.approx(31 / 11)
    assert claim.verdict == "holds"


def test_every_measure_has_a_direction():
    assert set(metrics.ALL) >= metrics.HIGHER_IS_BETTER
    assert {"tracking_first", "boundary_exits", "fire_losses", "time_to_full_coverage"}.isdisjoint(
        metrics.HIGHER_IS_BETTER
    )


@pytest.mark.slow
def test_verdicts(tmp_path):
    """The ratios are 2, 1 and about 1.3, with little or much spread between seeds."""
    cases = {"holds": (60, 30, 0), "does not hold": (30, 30, 0), "undecided": (39, 30, 10)}
    for verdict, (coverage, other, spread) in cases.items():
        for seed in range(5):
            shift = spread * (seed - 2) / 2
            write_run(tmp_path / verdict, "consensus", seed, learned={"coverage": coverage + shift})
            write_run(tmp_path / verdict, "positional", seed, learned={"coverage": other - shift})
        got = [v for v in only(tmp_path / verdict).verdicts if v.measure == "coverage"]
        assert [v.verdict for v in got] == [verdict]


@pytest.mark.parametrize(
    ("interval", "verdict"),
    [
        ((2.0, 3.0), "holds"),
        ((1.99999994, 3.0), "holds"),  # 2 in float32, rounded
        ((0.0, 1.99999996), "undecided"),
        ((0.0, 1.99), "does not hold"),
        ((1.99, 3.0), "undecided"),
        (None, "undecided"),
    ],
)
def test_rounding_does_not_decide_a_claim(interval, verdict):
    assert claims._decision(interval, 2.0) == verdict


def test_a_method_is_compared_with_the_best_other(tmp_path):
    for method, exits in (("consensus", 2), ("independent", 9), ("positional", 5)):
        for seed in range(2):
            write_run(tmp_path, method, seed, learned={"boundary_exits": exits})
    (claim,) = (v for v in only(tmp_path).verdicts if v.measure == "boundary_exits")
    assert (claim.best_other, claim.ratio) == ("positional", pytest.approx(2.5))
    assert claim.interval == pytest.approx((2.5, 2.5))


def test_a_ratio_to_zero_is_infinite(tmp_path, capsys):
    for method, exits in (("consensus", 0), ("independent", 9)):
        for seed in range(2):
            write_run(tmp_path, method, seed, learned={"boundary_exits": exits})
    assert main.main(["compare", str(tmp_path), "--output", str(tmp_path / "out")]) == 0
    assert "∞" in capsys.readouterr().out
    content = json.loads((tmp_path / "out" / "compare.json").read_text())
    claims = {claim["measure"]: claim for claim in content["setups"][0]["claims"]}
    assert claims["boundary_exits"]["interval"] == ["inf", "inf"]


def test_one_seed_has_no_interval(tmp_path, capsys):
    for method in ("consensus", "independent"):
        write_run(tmp_path, method, 0)
    section = only(tmp_path)
    for rank in section.fires["huygens"]:
        assert [row.interval for row in rank.rows] == [None, None]
        assert rank.rows[0].probability_interval is None
        if not rank.not_ranked:
            assert rank.rows[0].probability_of_improvement in (0, 0.5, 1)
    assert {v.verdict for v in section.verdicts} == {"undecided"}
    assert all(c.low is None for by in section.curves.values() for c in by.values())
    assert main.main(["compare", str(tmp_path), "--output", str(tmp_path / "out")]) == 0
    assert " 1* " in capsys.readouterr().out
    assert "With one seed there is no interval" in (tmp_path / "out/compare.html").read_text()


def test_two_seeds_are_flagged(runs, tmp_path, capsys):
    assert main.main(["compare", str(runs), "--output", str(tmp_path / "out")]) == 0
    assert " 2* " in capsys.readouterr().out
    assert "too few for an interval" in (tmp_path / "out/compare.html").read_text()


def test_groups_of_one_and_of_few_seeds_are_both_flagged(tmp_path, capsys):
    for seed, method in enumerate(["consensus", "independent", "independent"]):
        write_run(tmp_path, method, seed)
    assert main.main(["compare", str(tmp_path), "--output", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().out
    assert "* fewer than 5 seeds" in said
    assert [said.count(f" {seeds}* ") for seeds in (1, 2)] == [8, 8]
    page = (tmp_path / "out/compare.html").read_text()
    assert "With one seed there is no interval" in page
    assert "Fewer than 5 seeds, marked *" in page
    assert page.count('<td class="n">1*</td>') == 8


def test_scripted_policies_are_drawn_in_their_rows(tmp_path, monkeypatch):
    """A line is drawn only in the rows that have its value, independent of the rows' names."""
    assert list(plots._stretches([0, 1, 3, 5, 6])) == [(0, 1), (3, 3), (5, 6)]
    drawn = []
    plot = Axes.plot

    def watched(self, *args, **about):
        drawn.append((args, about))
        return plot(self, *args, **about)

    monkeypatch.setattr(Axes, "plot", watched)
    changed = ("comm.agree=false", "comm.wander=false")
    for seed, keys in enumerate([(), changed, ("env.radio.loss=0.5",)]):
        coverage = {"coverage": 90.0 - 10 * seed}
        run = write_run(
            tmp_path,
            "consensus",
            seed,
            overrides=keys,
            scripted=("follow_target",),
            learned=coverage,
        )
        content = read_evaluation(run)
        content["communication"] = {"follow_target": {"name": str(seed % 2)}}
        content["results"]["huygens"]["follow_target"]["coverage"] = [40.0 - 20 * (seed % 2)] * 4
        write_evaluation(run, content)
    section = only(tmp_path)
    assert [row.method for row in ranking(section, "coverage").rows][1].count(", ") == 1
    plots.frozen(tmp_path / "figure.png", section, "huygens")
    lines = [
        (args[0][0], *args[1])
        for args, about in drawn
        if about.get("zorder") == 1 and args[0][0] in (20.0, 40.0)
    ]
    # From the top: 90, 80 and 70 %. follow_target has 20 % in the middle row, else 40 %.
    assert sorted(lines)[:3] == [(20.0, 0.5, 1.5), (40.0, -0.5, 0.5), (40.0, 1.5, 2.5)]


def test_invalid_output_folder(runs, tmp_path, capsys):
    (tmp_path / "file").write_text("mine")
    (tmp_path / "link").symlink_to("nowhere")
    for output in ("file", "file/sub", "link", "x" * 300):
        assert main.main(["compare", str(runs), "--output", str(tmp_path / output)]) == 2
        said = capsys.readouterr().err
        where = f"emberlink compare: output {tmp_path / output}: "
        assert said.replace("\n", "").startswith(where), said
        assert said.count("\n") == 1
    assert (tmp_path / "file").read_text() == "mine"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "link"]


def test_an_empty_output_folder_stays_what_it_is(runs, tmp_path, monkeypatch):
    """A link, the working folder or a mount point is filled, not replaced."""
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to("real")
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    for output in (tmp_path / "link", Path(".")):
        assert main.main(["compare", str(runs), "--output", str(output)]) == 0
        assert (output / "compare.html").is_file()
        assert not list(output.glob(".*"))
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real" / "compare.json").is_file()


@pytest.mark.parametrize("exists", [False, True])
def test_a_report_that_was_made_meanwhile_is_not_overwritten(exists, runs, tmp_path, monkeypatch):
    folder, draw = tmp_path / "report", chapters.draw
    if exists:
        folder.mkdir()

    def slow(*arguments):
        folder.mkdir(exist_ok=True)
        (folder / "compare.html").write_text("theirs")
        return draw(*arguments)

    monkeypatch.setattr(chapters, "draw", slow)
    with pytest.raises(UserError, match="there is something by now"):
        compare([runs], output=folder)
    assert [file.name for file in folder.iterdir()] == ["compare.html"]
    assert (folder / "compare.html").read_text() == "theirs"
    assert [path.name for path in tmp_path.iterdir()] == ["report"]


def test_a_folder_whose_name_holds_no_characters_is_compared(tmp_path):
    folder = tmp_path / os.fsdecode(b"r\xfcns")
    run = write_run(folder, "consensus", 0)
    (run / "figures").mkdir(exist_ok=True)
    (run / "figures" / "replay.html").write_text("a replay")
    compare([folder], output=tmp_path / "report")
    page = (tmp_path / "report" / "compare.html").read_text()
    (address,) = re.findall(r'<a href="([^"]*)">replay</a>', page)
    assert (tmp_path / "report" / os.fsdecode(unquote_to_bytes(address))).is_file()
    json.loads((tmp_path / "report" / "compare.json").read_text())


def test_a_full_output_is_not_taken_for_the_folder(runs, tmp_path, capsys, monkeypatch):
    def fail(*_):
        raise OutputError(errno.ENOSPC, "No space left on device", "standard output")

    monkeypatch.setattr("emberlink.trainers.comparison.report.chapters.draw", fail)
    assert main.main(["compare", str(runs), "--output", str(tmp_path / "new")]) == 1
    assert capsys.readouterr().err == (
        "emberlink compare: standard output: cannot be written: No space left on device\n"
    )
    assert list(tmp_path.iterdir()) == []


def summary(section):
    """Returns all statistics of a section as plain numbers."""
    rows = [row for rank in section.fires["huygens"] for row in rank.rows]
    return [
        *((r.method, r.iqm, r.interval) for r in rows),
        *((r.probability_of_improvement, r.probability_interval) for r in rows),
        *((v.ratio, v.interval, v.verdict) for v in section.verdicts),
    ]


def approximately(value):
    if isinstance(value, list | tuple):
        return [approximately(v) for v in value]
    return pytest.approx(value, rel=1e-9) if isinstance(value, float) else value


def plain(value):
    return [plain(v) for v in value] if isinstance(value, list | tuple) else value


@pytest.mark.slow
def test_episodes_are_not_independent_runs(runs, tmp_path):
    """Repeating each episode ten times does not change the intervals."""
    copy = shutil.copytree(runs, tmp_path / "copy")
    for run in find([copy]):
        content = read_evaluation(run)
        content["fires"] *= 10
        for policies in content["results"].values():
            for measured in policies.values():
                measured |= {name: values * 10 for name, values in measured.items()}
        write_evaluation(run, content)
    assert plain(summary(only(copy))) == approximately(summary(only(runs)))
    # An additional seed does change them, so the comparison above can fail.
    write_run(copy, "consensus", 9, fires=40)
    assert plain(summary(only(copy))) != approximately(summary(only(runs)))


@pytest.mark.slow
def test_intervals_ignore_the_spread_within_a_run(tmp_path):
    for seed, mean in enumerate((20, 30, 40)):
        write_run(tmp_path / "calm", "consensus", seed, learned={"coverage": mean})
        wild = [mean - 20, mean + 20, mean - 15, mean + 15]
        write_run(tmp_path / "wild", "consensus", seed, learned={"coverage": wild})
    calm, wild = (ranking(only(tmp_path / n), "coverage").rows[0] for n in ("calm", "wild"))
    assert calm.interval == wild.interval == (20, 40)


@pytest.mark.heavy
@pytest.mark.drawn
def test_results_do_not_depend_on_the_order_of_runs(runs, tmp_path):
    folders = find([runs])
    whole = []
    for place, order in enumerate([folders, folders[::-1], [*folders[2:], *folders[:2]]]):
        out = tmp_path / str(place)
        assert main.main(["compare", *map(str, order), "--output", str(out)]) == 0
        whole.append({file.name: file.read_bytes() for file in out.iterdir()})
    assert whole[0] == whole[1] == whole[2]
    assert {"compare.html", "compare.json"} < whole[0].keys()
    assert sum(name.endswith(".png") for name in whole[0]) == 6


@pytest.mark.heavy
@settings(
    deadline=None, max_examples=6, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(st.lists(st.integers(1, 6), min_size=1, max_size=4), st.integers(0, 2**20))
def test_any_number_of_methods_and_seeds(tmp_path_factory, counts, start):
    folder = tmp_path_factory.mktemp("any")
    for method, count in zip(METHODS, counts, strict=False):
        for seed in range(count):
            write_run(folder, method, start + seed)
    section = only(folder)
    for rank in section.fires["huygens"]:
        rows = rank.rows
        assert {r.method: len(r.values) for r in rows} == dict(zip(METHODS, counts, strict=False))
        assert bool(rank.not_ranked) == (rank.measure == "mean_reward" and len(counts) > 1)
        if rank.not_ranked:
            assert [(r.method, r.next) for r in rows] == [(m, None) for m in METHODS[: len(rows)]]
        else:
            higher = rank.measure in metrics.HIGHER_IS_BETTER
            assert [r.iqm for r in rows] == sorted((r.iqm for r in rows), reverse=higher)
            assert [r.next for r in rows] == [*(r.method for r in rows[1:]), None]
        for row in rows:
            assert (row.interval is None) == (len(row.seeds) == 1)
            if row.interval:
                low, high = row.interval
                assert min(row.values) - 1e-9 <= low <= high <= max(row.values) + 1e-9
    assert len(section.verdicts) == (4 if len(counts) > 1 else 0)


def test_setups_fires_and_configurations_have_separate_sections(tmp_path):
    write_run(tmp_path, "consensus", 0)
    write_run(tmp_path, "consensus", 1, overrides=("learner.batch_size=64",))
    write_run(tmp_path, "consensus", 2, overrides=("learner.batch_size=64", "device=cpu"))
    write_run(tmp_path, "consensus", 0, name="r", overrides=("setup=released",))
    both = ("huygens", "paper")
    write_run(tmp_path, "consensus", 0, name="p", overrides=("fire=paper",), scenarios=both)
    sections, notes = gathered(tmp_path)
    assert [(s.label, [(g.label, g.seeds) for g in s.groups]) for s in sections] == [
        ("setup released, world paper, trained on paper", [("consensus", [0])]),
        (
            "setup tuned, world paper, trained on huygens",
            [("consensus", [0]), ("consensus (learner.batch_size=64)", [1, 2])],
        ),
        ("setup tuned, world paper, trained on paper", [("consensus", [0])]),
    ]
    assert [s.trained_on for s in sections] == ["", "huygens", "paper"]
    assert any("the groups differ in learner.batch_size" in note for note in notes)


def fewer_fires(content):
    content["fires"] = 2
    for measured in content["results"]["huygens"].values():
        measured |= {name: values[:2] for name, values in measured.items()}


@pytest.mark.slow
def test_runs_with_other_evaluations_have_separate_sections(tmp_path, capsys):
    """An example is a smoke test in the same folder."""
    for seed in range(2):
        write_run(tmp_path, "consensus", seed)
    write_run(tmp_path, "consensus", 0, name="short", overrides=("env.horizon=50",))
    spoil(write_run(tmp_path, "consensus", 0, name="few"), fewer_fires)
    spoil(write_run(tmp_path, "consensus", 0, name="starts"), lambda c: c.update(start_seed=2))
    assert main.main(["compare", str(tmp_path), "--output", str(tmp_path / "out")]) == 0
    sections = {
        numbers.section.label: numbers.section.runs for numbers in compare([tmp_path]).sections
    }
    usual = "setup tuned, world paper, trained on huygens (env.horizon="
    assert {label: [run.path.name for run in runs] for label, runs in sections.items()} == {
        f"{usual}40), 2 held-out fires, start_seed 1": ["few"],
        f"{usual}40), 4 held-out fires, start_seed 1": ["consensus_tuned_s0", "consensus_tuned_s1"],
        f"{usual}40), 4 held-out fires, start_seed 2": ["starts"],
        f"{usual}50), 4 held-out fires, start_seed 1": ["short"],
    }


def test_numbers_without_printing(runs, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    comparison = compare([str(runs)])
    (content,) = comparison.to_values()["setups"]
    assert [run["seed"] for run in content["runs"]] == [0, 1, 2, 0, 1]
    assert capsys.readouterr().out == ""
    assert not any(tmp_path.iterdir())
    with pytest.raises(ValueError, match="there is no such run folder"):
        compare([tmp_path / "missing"])


@pytest.mark.heavy
def test_different_rewards_are_not_ranked(tmp_path, capsys):
    """Rewards differ by their settings or by the reward of a scripted policy."""
    for seed in range(2):
        write_run(tmp_path / "settings", "consensus", seed)
        write_run(tmp_path / "settings", "independent", seed)
        write_run(tmp_path / "earned", "independent", seed)
        run = write_run(tmp_path / "earned", "positional", seed)
        content = read_evaluation(run)
        content["results"]["huygens"]["random_actions"]["mean_reward"] = [7.0] * 4
        write_evaluation(run, content)
    why = "mean_reward (not ranked: the methods' rewards differ"
    for name, because in (
        ("settings", f"{why} in env.reward.new_fire)"),
        ("earned", f"{why}: random_actions earns differently with them)"),
    ):
        rank = ranking(only(tmp_path / name), "mean_reward")
        assert [(r.next, r.probability_of_improvement) for r in rank.rows] == [(None, None)] * 2
        assert all(row.interval is not None for row in rank.rows)
        assert ranking(only(tmp_path / name), "coverage").not_ranked == ""
        out = tmp_path / f"out_{name}"
        assert main.main(["compare", str(tmp_path / name), "--output", str(out)]) == 0
        assert because in " ".join(page(out).text.split())
        said = " ".join(capsys.readouterr().out.split())
        assert "mean_reward is not ranked: the methods' rewards differ" in said
    # Runs of one method share a reward.
    assert (
        ranking(only(tmp_path / "earned" / "positional_tuned_s0"), "mean_reward").not_ranked == ""
    )


@pytest.mark.drawn
def test_an_evaluation_without_the_fire_trained_on(tmp_path):
    run = write_run(tmp_path, "consensus", overrides=("fire=paper",), scenarios=("elsewhere",))
    assert main.main(["compare", str(run), "--output", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out" / "1_tuned_frozen_1_elsewhere.png").stat().st_size > 10_000


def test_groups_are_named_by_their_settings(tmp_path):
    for seed, setting in enumerate(
        ("comm.agree=false", "env.radio.range=inf", "comm.follow=nearest")
    ):
        write_run(tmp_path, "consensus", seed, overrides=(setting,))
    write_run(tmp_path, "consensus", 9)
    (section,), _ = gathered(tmp_path)
    assert [group.label for group in section.groups] == [
        "consensus",
        "consensus (comm.agree=false)",
        "consensus (comm.follow=nearest)",
        "consensus (env.radio.range=inf)",
    ]


def test_runs_that_began_with_other_seeds_of_the_same_run_are_a_group(tmp_path, monkeypatch):
    """Three seeds began with seeds of the same settings, one of them by a relative path."""
    monkeypatch.chdir(tmp_path)
    for seed in range(3):
        first = write_run(tmp_path / "first", "consensus", seed, overrides=("learner=ippo",))
        start = first.relative_to(tmp_path) if seed == 2 else first
        more = ("learner=ippo", f"learner.warm_start={start}")
        write_run(tmp_path / "runs", "consensus", seed, overrides=more)
    other = write_run(tmp_path / "first", overrides=("learner=ippo", "learner.lr=0.5"), name="lr")
    for name, start in (("other", other), ("lost", tmp_path / "none")):
        more = ("learner=ippo", f"learner.warm_start={start}")
        write_run(tmp_path / "runs", name=name, overrides=more)
    write_run(tmp_path / "runs", name="cold", overrides=("learner=ippo",))
    (section,), notes = gathered(tmp_path / "runs")
    assert sorted(group.seeds for group in section.groups) == [[0], [0], [0], [0, 1, 2]]
    assert any("one group, though learner.warm_start differ" in note for note in notes)


def test_names_of_run_folders_lose_their_time_and_seed(tmp_path):
    configs = [resolve("consensus", [f"seed={seed}", f"output={tmp_path}"]) for seed in (3, 3, 12)]
    made = [str(RunFolder.create(config).path) for config in configs]
    assert len(set(made)) == 3
    assert {*map(without_time_and_seed, made)} == {str(tmp_path / "consensus_paper_paper")}
    named = str(RunFolder.create(configs[0], "mine_s3").path)
    assert without_time_and_seed(named) == named


def test_runs_that_began_with_seeds_of_a_lost_run_are_a_group(tmp_path):
    starts = [f"runs/2026-11-2{s}_01-36-35_consensus_tuned_front_s{s}" for s in range(3)]
    for seed, start in enumerate([*starts, "runs/2026-11-23_01-36-35_consensus_tuned_paper_s3"]):
        more = ("learner=ippo", f"learner.warm_start={start}")
        write_run(tmp_path / "runs", "consensus", seed, overrides=more)
    (section,), _ = gathered(tmp_path / "runs")
    assert [group.seeds for group in section.groups] == [[0, 1, 2], [3]]


def test_a_warm_start_is_part_of_a_name_only_if_nothing_else_tells_groups_apart(tmp_path):
    """A lost run's path stands in a label where two groups differ in nothing else."""
    starts = {"a": "runs/lost_a", "b": "runs/lost_b", "c": "runs/lost_c"}
    more = {"a": (), "b": (), "c": ("env.radio.range=0",)}
    for name, start in starts.items():
        settings = ("learner=ippo", f"learner.warm_start={start}", *more[name])
        write_run(tmp_path, "consensus", 0, overrides=settings, name=name)
    (section,), notes = gathered(tmp_path)
    assert [group.label for group in section.groups] == [
        "consensus (env.radio.range=0.0)",
        "consensus (learner.warm_start=runs/lost_a)",
        "consensus (learner.warm_start=runs/lost_b)",
    ]
    (note,) = (note for note in notes if "differ in learner.warm_start:" in note)
    assert "runs/lost_c for consensus (env.radio.range=0.0)" in note


def test_groups_of_other_learners_are_named_by_what_chooses_them(tmp_path):
    for seed, setting in enumerate(("learner=td3", "learner=ippo", "learner.critic=team")):
        write_run(tmp_path, "consensus", seed, overrides=(setting,))
    (section,), _ = gathered(tmp_path)
    labels = [group.label for group in section.groups]
    assert labels[0] == "consensus (learner.critic=team)"
    assert labels[1].startswith("consensus (learner=ippo")
    assert labels[2].startswith("consensus (learner=td3")
    assert not any("null" in label for label in labels)


def write_extra_evaluation(run, name, coverage, **about):
    """Writes an additional evaluation of a run, with lost messages."""
    content = read_evaluation(run)
    config = RunFolder(run).config()
    env = to_values(config)["env"]
    env["radio"]["loss"] = 0.5
    content |= {"environment": env, "communication": {"learned": config.comm}, **about}
    content["results"]["huygens"]["learned"]["coverage"] = [coverage] * 4
    (run / name).write_text(json.dumps(content))


@pytest.mark.drawn
def test_extra_evaluations_are_not_counted_as_runs(tmp_path, capsys):
    """They have rows in the tables, but no rankings, curves or colours."""
    for seed in (0, 1):
        run = write_run(tmp_path, "consensus", seed, learned={"coverage": 80 + seed})
        write_run(tmp_path, "independent", seed, learned={"coverage": 30 + seed})
        write_extra_evaluation(run, "eval_env.radio.loss=0.5.json", 60 + seed)
    for name, about in {
        "eval_step_7.json": {"checkpoint": "step_7.safetensors"},
        "eval_fires.json": {"fires": 4, "start_seed": 2},
    }.items():
        write_extra_evaluation(run, name, 10, **about)
    shutil.copy(run / "eval.json", run / "eval_the_same.json")
    shutil.copy(run / "eval_env.radio.loss=0.5.json", run / "eval_twice.json")
    assert main.main(["compare", str(tmp_path), "--output", str(tmp_path / "out")]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "eval_step_7.json is left out: evaluated otherwise: checkpoint is step_7" in said
    assert "eval_fires.json is left out: evaluated otherwise: start_seed is 2" in said
    assert "eval_twice.json is left out: has the settings of eval_env.radio.loss=0.5.json" in said
    assert "trained twice" not in said
    (section,) = json.loads((tmp_path / "out" / "compare.json").read_text())["setups"]
    (coverage,) = [r for r in section["fires"]["huygens"] if r["measure"] == "coverage"]
    assert [(r["method"], r["iqm"]) for r in coverage["rows"]] == [
        ("consensus", 80.5),
        ("consensus, evaluated with env.radio.loss=0.5", 60.5),
        ("independent", 30.5),
    ]
    # Two evaluations of the same runs are not independent samples.
    assert [r["probability_of_improvement"] for r in coverage["rows"]] == [None, 1.0, None]
    assert [r["evaluated_with"] for r in section["runs"]] == [{}] * 2 + [
        {"env.radio.loss": 0.5}
    ] * 2 + [{}] * 2
    assert {claim["method"] for claim in section["claims"]} == {"consensus"}
    assert section["curves"]["coverage"].keys() == {"consensus", "independent"}
    assert (tmp_path / "out" / "1_tuned_frozen_1_huygens.png").stat().st_size > 10_000


def test_scripted_policies_may_depend_on_the_messages(tmp_path):
    """Scripted follow_target depends on the messages, so each group has its own value."""
    for seed, (loss, coverage) in enumerate([(0.0, 40.0), (0.5, 20.0)]):
        run = write_run(
            tmp_path,
            "consensus",
            seed,
            overrides=(f"env.radio.loss={loss}",),
            scripted=("follow_target",),
        )
        content = read_evaluation(run)
        content["communication"] = {"follow_target": {"name": "consensus"}}
        content["environment"] = {"radio": {"range": 10.0, "loss": loss}}
        content["results"]["huygens"]["follow_target"]["coverage"] = [coverage] * 4
        write_evaluation(run, content)
    section = only(tmp_path)
    assert ranking(section, "coverage").scripted == {
        "follow_target": [
            Scripted(["consensus"], 40.0),
            Scripted(["consensus (env.radio.loss=0.5)"], 20.0),
        ]
    }
    assert not [note for note in section.notes if "follow_target" in note]


def test_settings_without_effect_on_training_are_noted_and_do_not_split_groups(tmp_path):
    write_run(tmp_path, "consensus", 0)
    write_run(tmp_path, "consensus", 1, overrides=("logger=csv", "output=elsewhere"))
    (section,), notes = gathered(tmp_path)
    assert [g.seeds for g in section.groups] == [[0, 1]]
    assert notes == [
        "setup tuned, world paper, trained on huygens, consensus: one group, though logger differ"
    ]


def test_a_seed_is_counted_once(tmp_path):
    old = write_run(tmp_path, "consensus", 0, name="2026-01-01", learned={"coverage": 1})
    new = write_run(tmp_path, "consensus", 0, name="2026-01-02", learned={"coverage": 2})
    write_run(tmp_path, "consensus", 1, learned={"coverage": 3})
    for order in permutations((old, new, tmp_path)):
        (section,), notes = gathered(*order)
        (row,) = ranking(numbers(section), "coverage").rows
        assert (row.seeds, row.values) == ([0, 1], [2, 3])
        (note,) = notes
        assert f"{new} is used, {old} is left out" in note


def test_scripted_policies_have_separate_rows(tmp_path):
    for seed in range(2):
        write_run(tmp_path, "consensus", seed)
        write_run(tmp_path, "positional", seed)
    content = read_evaluation(tmp_path / "positional_tuned_s0")
    expected = np.mean(content["results"]["huygens"]["random_actions"]["coverage"])
    section = only(tmp_path)
    rank = ranking(section, "coverage")
    assert [row.method for row in rank.rows].count("random_actions") == 0
    assert rank.scripted["random_actions"] == [Scripted([], pytest.approx(expected))]
    assert section.notes == []
    # The score depends on the method's reward and is the same in all runs of the method.
    for seed in range(2):
        run = tmp_path / f"positional_tuned_s{seed}"
        content = read_evaluation(run)
        content["results"]["huygens"]["random_actions"]["mean_reward"] = [7.0] * 4
        write_evaluation(run, content)
    section = only(tmp_path)
    consensus, positional = ranking(section, "mean_reward").scripted["random_actions"]
    assert positional == Scripted(["positional"], 7.0)
    assert consensus.methods == ["consensus"]
    assert consensus.value != 7
    assert section.notes == []
    # Coverage is the same on the same fires.
    content["results"]["huygens"]["random_actions"]["coverage"] = [7.0] * 4
    write_evaluation(run, content)
    (note,) = only(tmp_path).notes
    assert "random_actions does not have the same coverage" in note


def test_curves_are_over_seeds(runs):
    section = only(runs)
    lines = [
        [json.loads(line)["coverage"] for line in (run / "metrics.jsonl").read_text().splitlines()]
        for run in find([runs])
        if run.name.startswith("consensus")
    ]
    curve = section.curves["coverage"]["consensus"]
    assert curve.iqm == pytest.approx(np.mean(lines, axis=0))
    assert curve.low == pytest.approx(np.min(lines, axis=0))
    assert curve.high == pytest.approx(np.max(lines, axis=0))


class Tags(html.parser.HTMLParser):
    """Collects unclosed tags and loaded resources of an HTML page."""

    VOID = frozenset({"meta", "img", "br", "link"})

    def __init__(self):
        super().__init__()
        self.open, self.seen, self.loaded, self.text = [], set(), [], ""

    def handle_starttag(self, tag, attrs):
        self.seen.add(tag)
        self.loaded += [value for key, value in attrs if key in ("src", "href")]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


def page(folder) -> Tags:
    tags = Tags()
    tags.feed((folder / "compare.html").read_text())
    tags.close()
    assert tags.open == []
    return tags


def test_the_page_is_self_contained(runs, tmp_path):
    out = tmp_path / "out"
    assert main.main(["compare", str(runs), "--output", str(out)]) == 0
    tags = page(out)
    assert "script" not in tags.seen
    assert len(tags.loaded) == 6
    assert all(address.startswith("data:image/png;base64,iVBOR") for address in tags.loaded)
    source = (out / "compare.html").read_text()
    for scheme in ("http:", "https:", "//", "url(", "@import"):
        assert scheme not in source.replace("\n", " ").split("base64,")[0]
        assert scheme not in tags.text
    for said in (*metrics.NAMES, "consensus", "independent", "60.0", "[50.0, 70.0]", "figure 9"):
        assert said in tags.text
    content = json.loads((out / "compare.json").read_text())
    (setup,) = content["setups"]
    coverage = next(r for r in setup["fires"]["huygens"] if r["measure"] == "coverage")
    assert coverage["rows"][0]["values"] == [50, 70, 60]
    assert setup["curves"]["coverage"].keys() == {"consensus", "independent"}
    assert content["settings"]["resamples"] == 10_000


def test_words_of_a_table_are_not_broken_on_narrow_screens():
    """A table scrolls in its own box; only paths may be broken anywhere."""
    source = files("emberlink.trainers.comparison.report").joinpath("page.html").read_text("utf-8")
    style = source.split("<style>")[1].split("</style>")[0]
    rules = dict(re.findall(r"([^{}\n]+) \{([^{}]*)\}", style))
    broken = {name for name, rule in rules.items() if "anywhere" in rule}
    assert broken == {"td.path", ".notes", "pre"}
    assert "overflow-x: auto" in rules[".wide"]
    assert source.count("<table>") == source.count('<div class="wide"><table>') > 2


HOSTILE = '<script>alert("1")</script>[red]$x_{/../'


def test_names_from_files_are_escaped(tmp_path, capsys):
    """They are no markup of the page, of the console or of formulas in a figure."""
    run = write_run(tmp_path / "runs", name="a<b>&'\"")
    content = read_evaluation(run)
    results = content["results"]
    results["huygens"][HOSTILE] = results["huygens"]["random_actions"]
    results[HOSTILE] = results["huygens"]
    write_evaluation(run, content)
    assert main.main(["compare", str(run), "--output", str(tmp_path / "out")]) == 0
    tags = page(tmp_path / "out")
    assert "script" not in tags.seen
    assert HOSTILE in tags.text
    assert HOSTILE in "".join(capsys.readouterr().out.split("\n"))
    assert all(file.parent == tmp_path / "out" for file in (tmp_path / "out").rglob("*"))


def test_unfinished_runs_are_noted_and_left_out(tmp_path, capsys):
    runs = tmp_path / "runs"
    good = write_run(runs, "consensus", 0)
    stopped = write_run(runs, "consensus", 1)
    lines = (stopped / "metrics.jsonl").read_text().splitlines(keepends=True)
    (stopped / "metrics.jsonl").write_text(lines[0])
    bare = write_run(runs, "consensus", 2)
    (bare / "eval.json").unlink()
    older = write_run(runs, "consensus", 3)
    (older / "checkpoints").mkdir()
    (older / "checkpoints" / "step_000000160.safetensors").touch()
    (runs / "notes").mkdir()
    assert main.main(["compare", str(runs), str(good), "--output", str(tmp_path / "out")]) == 0
    said = " ".join(capsys.readouterr().out.replace("\n", " ").split())
    content = json.loads((tmp_path / "out" / "compare.json").read_text())
    assert {entry["run"]: entry["why"][:22] for entry in content["left_out"]} == {
        str(stopped): "unfinished: 1 of 3 epi",
        str(bare): "not evaluated: there i",
        str(older): "eval.json is of step_0",
    }
    assert [run["seed"] for run in content["setups"][0]["runs"]] == [0]
    for name in (stopped.name, bare.name, older.name):
        assert f"{name} is left out" in page(tmp_path / "out").text
    assert said.count("is left out") == 3


def spoil(run, change):
    content = read_evaluation(run)
    change(content)
    write_evaluation(run, content)


def lacking(content):
    del content["results"]["huygens"]["learned"]["fire_losses"]


def shorter(content):
    content["results"]["huygens"]["learned"]["coverage"].pop()


def not_a_number(content):
    content["results"]["huygens"]["learned"]["coverage"][1] = float("nan")


SPOILT = {
    "text": (lambda run: (run / "eval.json").write_text("{"), ("eval.json", "JSON")),
    "a list": (lambda run: (run / "eval.json").write_text("[]"), ("eval.json",)),
    "binary": (lambda run: (run / "eval.json").write_bytes(b"\xff\xfe"), ("eval.json",)),
    "a measure": (lambda run: spoil(run, lacking), ("eval.json", "learned lacks fire_losses")),
    "an episode": (lambda run: spoil(run, shorter), ("coverage has 3 episodes; fires=4",)),
    "nan": (lambda run: spoil(run, not_a_number), ("eval.json", "coverage.1=nan", "finite")),
    "no fire": (lambda run: spoil(run, lambda c: c["results"].clear()), ("no fire",)),
    "no learned": (
        lambda run: spoil(run, lambda c: c["results"]["huygens"].pop("learned")),
        ("has no policy 'learned'",),
    ),
    "another's": (lambda run: spoil(run, lambda c: c.update(seed=5)), ("seed=5", "says 1")),
    "held-out": (
        lambda run: spoil(run, lambda c: c.update(held_out={"huygens": {"fire_seeds": [9]}})),
        ("were not evaluated on the same fires of huygens",),
    ),
    "scenario": (
        lambda run: spoil(run, lambda c: c.update(results={"x": c["results"]["huygens"]})),
        ("was evaluated on huygens", "on x"),
    ),
    "config": (
        lambda run: (run / "config.yaml").write_text("seed: 1"),
        ("config.yaml", "'method' is missing"),
    ),
    "metrics": (
        lambda run: (run / "metrics.jsonl").write_text("{}\n"),
        ("metrics.jsonl: ", "line"),
    ),
    "metrics' json": (
        lambda run: (run / "metrics.jsonl").write_text("{\n"),
        ("metrics.jsonl: not a file of JSON lines",),
    ),
    "an episode twice": (
        lambda run: (run / "metrics.jsonl").write_text(
            2 * (run / "metrics.jsonl").read_text().splitlines(keepends=True)[0]
        ),
        ("metrics.jsonl: line 2 is not of episode 2",),
    ),
    "a curve": (
        lambda run: (run / "metrics.jsonl").write_text('{"episode": 1, "mean_reward": null}\n'),
        ("metrics.jsonl: ", "number"),
    ),
}


@pytest.mark.parametrize("case", SPOILT)
def test_errors_are_one_line_and_leave_no_files(case, tmp_path, capsys):
    change, said = SPOILT[case]
    write_run(tmp_path / "runs", "consensus", 0)
    change(write_run(tmp_path / "runs", "independent", 1))
    assert main.main(["compare", str(tmp_path / "runs"), "--output", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert error.startswith("emberlink compare: ")
    assert error.count("\n") == 1
    for part in said:
        assert part in error
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]


def test_without_runs(tmp_path, capsys):
    for path, said in (
        (tmp_path, "neither a run folder nor a folder that holds runs"),
        (tmp_path / "missing", "there is no such run folder"),
    ):
        assert main.main(["compare", str(path)]) == 2
        assert said in capsys.readouterr().err
    run = write_run(tmp_path)
    (run / "eval.json").unlink()
    assert main.main(["compare", str(run)]) == 2
    assert capsys.readouterr().err == (
        "emberlink compare: no finished run among 1: nothing to compare; "
        f"{run}: not evaluated: there is no eval.json (emberlink eval {run})\n"
    )


def test_nothing_is_overwritten(runs, tmp_path, monkeypatch, capsys):
    taken = tmp_path / "taken"
    taken.mkdir()
    (taken / "mine").write_text("x")
    for path in (taken, taken / "mine"):
        assert main.main(["compare", str(runs), "--output", str(path)]) == 2
        assert "exists and is not an empty folder" in capsys.readouterr().err
    assert [file.name for file in taken.iterdir()] == ["mine"]
    monkeypatch.chdir(tmp_path)
    for name in ("compare", "compare_2"):
        assert main.main(["compare", str(runs)]) == 0
        assert capsys.readouterr().out.rstrip().splitlines()[-1] == f"{name}/compare.html"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["compare", "compare_2", "taken"]


@pytest.mark.slow
@pytest.mark.drawn
def test_a_real_run_has_a_timelapse(finished, tmp_path):
    assert main.main(["compare", str(finished.parent), "--output", str(tmp_path / "out")]) == 0
    (timelapse,) = (tmp_path / "out").glob("*timelapse*.png")
    tags = page(tmp_path / "out")
    pictures = [address for address in tags.loaded if address.startswith("data:image")]
    assert len(pictures) == 5 + 2 + 1  # figures 5 to 9: one for each fire, and the timelapse
    assert "frozen policy of step_000000030.safetensors" in tags.text
    assert timelapse.stat().st_size > 1000


def test_help_of_compare_has_a_description_and_an_example(capsys):
    with pytest.raises(SystemExit) as ended:
        main.main(["compare", "--help"])
    assert ended.value.code == 0
    assert "example:\n  emberlink compare" in capsys.readouterr().out


def test_the_page_links_to_the_replays_of_runs(runs, tmp_path):
    folder = shutil.copytree(runs, tmp_path / "my runs & <b>")
    with_replay = sorted(folder.iterdir())[0]
    (with_replay / "figures").mkdir(exist_ok=True)
    (with_replay / "figures" / "replay.html").write_text("a replay")
    compare([folder], output=tmp_path / "report")
    page = (tmp_path / "report" / "compare.html").read_text()
    (address,) = re.findall(r'<a href="([^"]*)">replay</a>', page)
    target = (tmp_path / "report" / unquote(html.unescape(address))).resolve()
    assert target == (with_replay / "figures" / "replay.html").resolve()
    assert not address.startswith("/")


def test_the_page_links_to_a_replay_also_of_runs_without_one(run, tmp_path):
    shutil.rmtree(run / "figures")  # as the trained policies that come with emberlink
    compare([run], output=tmp_path / "report")
    page = (tmp_path / "report" / "compare.html").read_text()
    assert re.findall(r'<a href="([^"]*)">Replay</a>', page) == ["1_paper_replay.html"]
    header = data_of((tmp_path / "report" / "1_paper_replay.html").read_text())
    assert [panel["title"] for panel in header["panels"]] == ["consensus, seed 0"]
    assert header["fire"] == "huygens:0"
    assert header["horizon"] == 15
