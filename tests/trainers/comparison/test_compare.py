"""Tests `emberlink compare`: its rows, its numbers, the difference, its claims and its page."""

import html.parser
import json
import math
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from refusal import refused
from synthetic_runs import evaluate_otherwise, read_evaluation, write_evaluation, write_run

from emberlink.envs import metrics
from emberlink.envs.utils.errors import UserError
from emberlink.trainers.cli import main
from emberlink.trainers.comparison import claims
from emberlink.trainers.comparison.bootstrap import crossed_interval, crossed_p, iqm, iqm_difference
from emberlink.trainers.comparison.comparison import compare_runs

LOSS, LOST = {"loss": 0.5}, "consensus, evaluated with env.radio.loss=0.5"
START = "learner.warm_start"


def only(comparison, measure="coverage"):
    """Returns the rows of a measure of the trained policies, by label."""
    ranking = comparison.ranking
    ranking = ranking[(ranking["measure"] == measure) & (ranking["policy"] == "learned")]
    return ranking.set_index("label")


def labels(*paths, names=()):
    """Returns section -> label -> seeds."""
    runs = compare_runs(paths, names).runs
    seeds = runs.groupby(["section", "label"], sort=False)["seed"].agg(list)
    return {section: seeds[section].to_dict() for section in runs["section"].unique()}


def change(run, **values):
    write_evaluation(run, read_evaluation(run) | values)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Writes three seeds of consensus, also with lost messages, two of independent and one."""
    folder = tmp_path_factory.mktemp("runs")
    for seed, coverage in enumerate((50, 70, 60)):
        learned = {"coverage": [coverage - 5, coverage + 5] * 2}
        run = write_run(folder, "consensus", seed, learned=learned)
        evaluate_otherwise(run, LOSS, learned=30 + seed)
    for seed, coverage in enumerate((40, 65)):
        write_run(folder, "independent", seed, learned={"coverage": coverage})
    write_run(folder, "positional", learned={"coverage": 20})
    return folder


@pytest.fixture(scope="module")
def comparison(runs):
    return compare_runs([runs])


def test_numbers_by_hand(comparison):
    rows = only(comparison)
    assert list(rows.index) == ["consensus", "independent", LOST, "positional"]
    first = rows.loc["consensus"]
    assert (first["seeds"], first["values"], first["iqm"]) == ([0, 1, 2], [50, 70, 60], 60)
    assert (first["low"], first["high"], first["next"]) == (50, 70, "independent")
    # 50 is above 40, 70 above both, 60 above 40: 4 of 6 pairs.
    assert first["probability"] == pytest.approx(4 / 6)
    claim = comparison.claims.set_index("measure").loc["coverage"]
    assert (claim["ratio"], claim["best_other"]) == (60 / 52.5, "independent")
    assert (claim["verdict"], claim["fewest_seeds"]) == ("undecided", 1)


def test_with_one_seed_there_is_no_interval_and_no_probability(comparison, tmp_path):
    row = only(comparison).loc["positional"]
    assert pd.isna([row["low"], row["high"]]).all()
    assert pd.isna(only(comparison).loc[LOST, "probability"])  # the next has one seed
    write_run(tmp_path)
    alone = compare_runs([tmp_path])
    assert alone.ranking[["low", "probability", "probability_low"]].isna().all(axis=None)
    assert alone.curves[["low", "high"]].isna().all(axis=None)


def test_the_table_is_tidy(comparison):
    table = comparison.table
    columns = {"run", "label", "method", "world", "radio", "seed", "policy", "fires", "fire"}
    assert columns | {"measure", "value"} <= set(table.columns)
    cells = ["run", "evaluated_with", "policy", "fires", "fire", "measure"]
    assert not table.duplicated(cells).any()
    mine = table[(table["method"] == "consensus") & (table["seed"] == 1)]
    mine = mine[(mine["measure"] == "coverage") & (mine["policy"] == "learned")]
    assert mine.groupby("radio")["value"].agg(list).to_dict() == {
        "range 10": [65, 75, 65, 75],
        "range 10, loss 0.5": [31] * 4,
    }


def test_measures_where_lower_is_better(tmp_path):
    for seed in range(3):
        write_run(tmp_path, "consensus", seed, learned={"tracking_first": 10 + seed})
        write_run(tmp_path, "positional", seed, learned={"tracking_first": 30 + seed})
    comparison = compare_runs([tmp_path])
    rows = only(comparison, "tracking_first")
    assert list(rows.index) == ["consensus", "positional"]
    assert rows["probability"].iloc[0] == 1
    claim = comparison.claims.set_index("measure").loc["tracking_first"]
    assert (claim["ratio"], claim["verdict"]) == (pytest.approx(31 / 11), "holds")


def test_setups_fires_and_evaluations_have_separate_sections(tmp_path):
    write_run(tmp_path, "consensus", 0)
    write_run(tmp_path, "consensus", 1, overrides=("learner.batch_size=64",))
    write_run(tmp_path, "consensus", 2, overrides=("learner.batch_size=64", "device=cpu"))
    write_run(tmp_path, "consensus", 0, name="r", overrides=("setup=released",))
    write_run(tmp_path, "consensus", 0, name="short", overrides=("env.horizon=50",))
    change(write_run(tmp_path, "consensus", 0, name="starts"), start_seed=2)
    of_fire = read_evaluation(write_run(tmp_path, "consensus", 0, name="huygens"))["results"]
    change(tmp_path / "huygens", results=of_fire | {"paper": of_fire["huygens"]})
    for seed, edition in enumerate((1, 2)):
        write_run(tmp_path, "maps", seed, overrides=("world=front", f"edition={edition}"))
    tuned = "setup tuned, world paper, trained on huygens"
    assert labels(tmp_path) == {
        "setup released, world paper, trained on paper": {"consensus": [0]},
        tuned: {
            "consensus (learner.batch_size=256)": [0],
            "consensus (learner.batch_size=64)": [1, 2],
        },
        f"{tuned} (start_seed=2)": {"consensus": [0]},
        f"{tuned} (held_out=huygens, paper)": {"consensus": [0]},
        f"{tuned} (env.horizon=50)": {"consensus": [0]},
        "setup tuned, world front, trained on front": {"maps": [0]},  # as most runs
        "setup tuned, world front, trained on front (edition=2)": {"maps": [1]},
    }


def test_labels_name_the_settings_that_tell_runs_apart(tmp_path):
    changes = ("comm.agree=false", "env.radio.range=inf", "comm.follow=nearest", "seed=0")
    for seed, setting in enumerate(changes):
        write_run(tmp_path, "consensus", seed, overrides=(setting,))
    write_run(tmp_path, "independent", 7, overrides=("learner.batch_size=64",))
    write_run(tmp_path, "independent", 8, overrides=("learner=ippo",))
    ((_, of_section),) = labels(tmp_path).items()
    assert of_section == {
        "consensus": [3],
        "consensus (comm.agree=false)": [0],
        "consensus (comm.follow=nearest)": [2],
        "consensus (env.radio.range=inf)": [1],
        "independent": [7],
        "independent (learner=ippo)": [8],
    }


def test_labels_of_the_user(tmp_path):
    for name in ("mine", "theirs"):
        for seed in range(2):
            write_run(tmp_path / name, "consensus", seed)
    paths = [tmp_path / "mine", tmp_path / "theirs"]
    ((_, of_section),) = labels(*paths, names=["A", "B"]).items()
    assert of_section == {"A": [0, 1], "B": [0, 1]}
    with pytest.raises(UserError, match="1 labels for 2 paths"):
        compare_runs(paths, ["A"])


def test_seeds_with_a_warm_start_each_are_one_row(tmp_path):
    for seed in range(3):
        start = f"runs/2026-11-2{seed}_01-36-35_maps_tuned_front_s{seed}"
        write_run(tmp_path, "consensus", seed, overrides=("learner=ippo", f"{START}={start}"))
    write_run(tmp_path, "consensus", 3, overrides=("learner=ippo", f"{START}=runs/other"))
    for seed in (4, 5):  # of a sweep
        start = f"runs/independent_tuned_front_s{seed}_1f0c3a{seed}e"
        write_run(tmp_path, "consensus", seed, overrides=("learner=ippo", f"{START}={start}"))
    ((_, of_section),) = labels(tmp_path).items()
    assert sorted(of_section.values()) == [[0, 1, 2], [3], [4, 5]]


def test_a_seed_is_counted_once(tmp_path):
    for name, coverage in (("2026-01-01", 1), ("2026-01-02", 2), ("pretrained_consensus_s0", 9)):
        write_run(tmp_path, "consensus", 0, name=name, learned={"coverage": coverage})
    write_run(tmp_path, "consensus", 1, learned={"coverage": 3})
    comparison = compare_runs([tmp_path])
    assert only(comparison)["values"].iloc[0] == [2, 3]
    left_out = {path.rpartition("/")[2] for path, _ in comparison.left_out}
    assert left_out == {"2026-01-01", "pretrained_consensus_s0"}


def test_other_evaluations_are_not_counted_as_runs(comparison, runs, tmp_path):
    """They have rows in the tables, but no claims and curves, and are no independent samples."""
    assert set(comparison.claims["label"]) == {"consensus"}
    assert LOST not in set(comparison.curves["label"])
    run = write_run(tmp_path)
    for name in ("eval_lost.json", "eval_twice.json", "eval_step_7.json"):
        evaluate_otherwise(run, LOSS, name)
    content = json.loads((run / "eval_step_7.json").read_text())
    (run / "eval_step_7.json").write_text(json.dumps(content | {"step": 7}))
    content = read_evaluation(run) | {"message_fault": "zero"}
    (run / "eval_fault.json").write_text(json.dumps(content))
    found = compare_runs([run])
    named = "consensus, evaluated with evaluation.message_fault=zero"
    assert sorted(found.runs["label"]) == ["consensus", LOST, named]
    left_out = {path.rpartition("/")[2] for path, _ in found.left_out}
    assert left_out == {run.name, "eval_step_7.json"}, "the first has the same settings twice"


def test_scripted_policies_have_rows_of_their_own(tmp_path):
    for seed in range(2):
        for method, more in (("consensus", {}), ("positional", {"mean_reward": 7.0})):
            scripted = {"random_actions": {"coverage": 5.0, **more}}
            write_run(tmp_path, method, seed, scripted=scripted)
    ranking = compare_runs([tmp_path]).ranking
    rows = ranking[ranking["policy"] == "random_actions"].set_index(["measure", "label"])["iqm"]
    assert rows["coverage"].to_dict() == {"random actions": 5.0}
    assert rows["mean_reward", "random actions (positional)"] == 7.0


def test_different_rewards_are_not_ranked(tmp_path):
    for seed in range(2):
        write_run(tmp_path, "consensus", seed)
        write_run(tmp_path, "independent", seed)
    comparison = compare_runs([tmp_path])
    rows = only(comparison, "mean_reward")
    assert "env.reward.new_fire" in rows["not_ranked"].iloc[0]
    assert set(rows["next"]) == {""}
    assert rows["low"].notna().all()
    assert set(only(comparison)["not_ranked"]) == {""}


def test_difference_by_hand(comparison):
    value, ends, p = comparison.difference("consensus", "independent", "coverage")
    first = np.array([[45.0, 55, 45, 55], [65, 75, 65, 75], [55, 65, 55, 65]])
    second = np.repeat([[40.0], [65]], 4, axis=1)
    assert value == 60 - 52.5
    assert ends == crossed_interval(iqm_difference, first, second)
    assert p == crossed_p(iqm_difference, first, second)
    row = comparison.ranking.query("label == 'consensus' and measure == 'coverage'").iloc[0]
    assert (row["low"], row["high"]) == crossed_interval(iqm, first)
    assert comparison.difference(LOST, "positional", "coverage") == (31 - 20, None, None)
    for wrong in (("consensu", "coverage"), ("positional", "mean_reward"), (LOST, "coverage")):
        with pytest.raises(UserError, match=r"is not known|rewards differ|same runs"):
            comparison.difference("consensus", *wrong)


def test_verdicts(tmp_path):
    """The ratios are 2, 1 and about 1.3, with little or much spread between seeds."""
    cases = {"holds": (60, 30, 0), "does not hold": (30, 30, 0), "undecided": (39, 30, 10)}
    for verdict, (coverage, other, spread) in cases.items():
        for seed in range(5):
            shift = spread * (seed - 2) / 2
            write_run(tmp_path / verdict, "consensus", seed, learned={"coverage": coverage + shift})
            write_run(tmp_path / verdict, "positional", seed, learned={"coverage": other - shift})
        found = compare_runs([tmp_path / verdict]).claims.set_index("measure")
        assert found.loc["coverage", "verdict"] == verdict
    assert claims.decision((1.99999994, 3.0), 2.0) == "holds"  # 2 in float32, rounded


def test_claims_compare_runs_that_were_trained_alike(tmp_path):
    """Consensus with a batch of 64 is compared with independent with 64, not with the better 32."""
    for size in (64, 32):
        for method, coverage in (("consensus", 1.2 * size), ("independent", size)):
            setting, learned = (f"learner.batch_size={size}",), {"coverage": coverage}
            write_run(tmp_path, method, name=f"{method}{size}", overrides=setting, learned=learned)
    write_run(tmp_path, "consensus", name="8", overrides=("learner.batch_size=8",))
    radio = ("learner.batch_size=64", "env.radio.range=5", "comm.agree=false")
    write_run(tmp_path, "consensus", name="radio", overrides=radio, learned={"coverage": 32.0})
    comparison = compare_runs([tmp_path])
    found = comparison.claims[comparison.claims["measure"] == "coverage"]
    assert sorted(found["ratio"]) == pytest.approx([0.5, 1.2, 1.2])
    assert any("no claims" in note and "batch_size=8" in note for note in comparison.notes)


class Page(html.parser.HTMLParser):
    """Collects the tags, loaded resources and text of compare.html."""

    def __init__(self, folder: Path):
        super().__init__()
        self.tags, self.loaded, self.text = set(), [], ""
        self.feed((folder / "compare.html").read_text())

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        self.loaded += [value for key, value in attrs if key in ("src", "href")]

    def handle_data(self, data):
        self.text += data


def test_the_report_is_one_page(runs, tmp_path, capsys):
    out = tmp_path / "out"
    assert main.main(["compare", str(runs), "--output", str(out)]) == 0
    assert sorted(file.name for file in out.iterdir()) == ["compare.html", "compare.json"]
    page = Page(out)
    assert "script" not in page.tags
    assert len(page.loaded) == 6
    assert all(address.startswith("data:image/png;base64,iVBOR") for address in page.loaded)
    printed = " ".join(capsys.readouterr().out.split())
    for said in (*metrics.NAMES, "consensus", "independent", "60.0", "[50.0, 70.0]", "3*"):
        assert said in page.text
        assert said in printed
    assert "With one seed there is no interval" in page.text
    content = json.loads((out / "compare.json").read_text())
    rows = [row for row in content["ranking"] if row["measure"] == "coverage"]
    assert rows[0]["values"] == [50, 70, 60]
    assert content["settings"]["resamples"] == 10_000


def test_extras(runs, tmp_path):
    out = tmp_path / "out"
    assert main.main(["compare", str(runs), "--output", str(out), "--marl-eval", "--svg"]) == 0
    assert len(list(out.glob("*.svg"))) == 6
    (tasks,) = json.loads((out / "marl_eval.json").read_text()).values()
    ((_, algorithms),) = tasks.items()
    assert sorted(algorithms["consensus"]) == ["run_0", "run_1", "run_2"]
    first = algorithms["consensus"]["run_0"]
    measures = {frozenset(step) - {"step_count"} for step in first.values()}
    assert len(measures) == 1, "MARL-eval wants the same ones everywhere"
    assert first["absolute_metrics"]["coverage"] == [45, 55, 45, 55]
    assert [first[f"step_{i}"]["step_count"] for i in (1, 2, 3)] == [40 * 16 * i for i in (1, 2, 3)]


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
    page = Page(tmp_path / "out")
    assert "script" not in page.tags
    assert HOSTILE in page.text
    assert HOSTILE.replace("_", " ") in "".join(capsys.readouterr().out.split("\n"))
    assert all(file.parent == tmp_path / "out" for file in (tmp_path / "out").rglob("*"))


def test_nothing_is_overwritten(tmp_path_factory, tmp_path, monkeypatch, capsys):
    run = write_run(tmp_path_factory.mktemp("one"))
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "mine").write_text("x")
    (tmp_path / "link").symlink_to("nowhere")
    monkeypatch.chdir(tmp_path)
    for output in ("taken", "taken/mine", "taken/mine/sub", "link", "x" * 300):
        refused(["compare", run, "--output", output], capsys, f"output {output}: ")
    for name in ("compare", "compare_2"):
        assert main.main(["compare", str(run)]) == 0
        assert capsys.readouterr().out.rstrip().splitlines()[-1] == f"{name}/compare.html"
    assert {file.name for file in tmp_path.iterdir()} == {"compare", "compare_2", "taken", "link"}
    assert [file.name for file in (tmp_path / "taken").iterdir()] == ["mine"]


SPOILT = {
    "no json": (lambda run: (run / "eval.json").write_text("{"), "eval.json"),
    "nan": (lambda run: evaluate_otherwise(run, LOSS, "eval.json", learned=math.nan), "finite"),
    "not evaluated": (lambda run: (run / "eval.json").unlink(), "emberlink eval"),
    "unfinished": (lambda run: (run / "metrics.jsonl").write_text(""), "unfinished: 0 of 3"),
    "metrics": (lambda run: (run / "metrics.jsonl").write_text("{\n" * 3), "metrics.jsonl"),
}


@pytest.mark.parametrize("case", SPOILT)
def test_a_run_that_cannot_be_read_costs_its_row(case, tmp_path, capsys):
    spoil, why = SPOILT[case]
    runs = tmp_path / "runs"
    write_run(runs, "consensus")
    run = write_run(runs, "independent", 1)
    spoil(run)
    comparison = compare_runs([runs])
    ((path, said),) = comparison.left_out
    assert path == str(run)
    assert why in said
    assert "\n" not in said
    assert list(comparison.runs["method"]) == ["consensus"]
    refused(["compare", run, "--output", tmp_path / "out"], capsys, why)
    assert not (tmp_path / "out").exists()


def test_a_run_that_was_trained_on_is_left_out(finished, tmp_path):
    run = shutil.copytree(finished, tmp_path / "run")
    change(run, step=15)
    with pytest.raises(UserError, match=r"eval.json is of step 15, the newest checkpoint of 30"):
        compare_runs([run])
