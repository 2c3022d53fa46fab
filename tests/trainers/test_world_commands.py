"""Tests `emberlink world check` and `emberlink world sweep`."""

import json
from itertools import product

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from emberlink.envs.scenarios import fires_of
from emberlink.policies.scripted.registry import SCRIPTED
from emberlink.trainers.cli import main
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.evaluation import evaluate
from emberlink.trainers.runs.lock import Lock
from emberlink.trainers.worlds import check, plot, sweep, worth
from emberlink.trainers.worlds.axes import Axes, World, base_config, derived
from emberlink.trainers.worlds.conditions import conditions
from emberlink.trainers.worlds.play import play_validation
from emberlink.trainers.worlds.plot import sweep_figure
from emberlink.trainers.worlds.sweep_folder import SweepFolder
from emberlink.trainers.worlds.variants import NO_LIMITS, NO_RADIO, play_ranges

POLICIES = ("random_waypoints", "map_greedy_alone", "map_greedy_all", "oracle")
TINY = ("env.grid=[12,12]", "env.horizon=12", "env.num_uavs=2")
SWEPT = (
    *("env.horizon=40", "fire.core_radius=[3,4]"),
    *("--speeds", "1,2", "--grids", "20", "--teams", "3", "--ranges", "0.1,1000", "--fires", "2"),
)


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


def test_what_merging_adds_is_in_points_and_in_percent_of_the_age():
    *_, merging = conditions(made_up((0, 70.0, 82.5, 0), (9, 40.0, 30.0, 9)), "coverage")
    assert merging.figures == {"coverage, points": 12.5, "front_age, % less": 25.0}


def made_up_play(coverage, age=30.0):
    """Returns a replacement of `played` with made-up measures of two fires."""
    shares = dict(zip(POLICIES, coverage, strict=True))

    def played(config, policy, *, fires, split, report=None):
        from emberlink.envs import metrics

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
    assert "note: world file is left out: fire.path=null: a file is needed" in notes
    assert "note: world paper is left out: evaluation.scripted lacks map_greedy_alone" in notes


def test_check_plays_on_validation_fires_as_an_evaluation_does(tmp_path):
    file = tmp_path / "out.json"
    arguments = ["world", "check", "front", *TINY, "--fires", "3", "--json", str(file)]
    assert main.main([*arguments, "--validation"]) in (0, 1)
    found = json.loads(file.read_text())["front"]
    config = resolve("independent", ["world=front", *TINY])
    fires = fires_of(config.fire).validation(3, (12, 12), 12)
    measured = evaluate.play_blocks(
        config, SCRIPTED["map_greedy"], fires, start_seed=evaluate.VALIDATION_START_SEED, block=3
    )
    assert (found["split"], found["fires"]) == ("validation", 3)
    for name, values in measured.items():
        assert found["means"]["map_greedy"][name] == pytest.approx(np.mean(values), abs=6e-4)
    file.unlink()
    assert main.main(arguments) in (0, 1)
    again = json.loads(file.read_text())["front"]
    assert again["split"] == "test"
    assert again["means"] != found["means"]


def test_a_gain_is_a_mean_of_differences_with_its_standard_error():
    assert sweep._gain([10.0, 20.0, 30.0], [11.0, 22.0, 33.0]) == [
        2.0,
        0.577,
    ]  # differences 1, 2, 3: 1 / sqrt(3)


def test_noise_is_no_worth():
    assert worth.clear([4.1, 2.0])
    assert worth.clear([-4.1, 2.0])
    assert not worth.clear([4.0, 2.0])
    assert not worth.clear([0.0, 0.0])
    assert worth.nothing([1.0, 0.5])
    assert worth.nothing([0.0, 0.0])
    assert not worth.nothing([-1.1, 0.5])
    assert not worth.nothing([0.0, 3.0])


def line(world: World, gain, full=(5.0, 1.0)):
    return {
        **world._asdict(),
        "headline": [9, 50, 50 + gain[0], 55],
        "gain": gain,
        "gain_all": full,
    }


def test_the_summary_counts_worlds_and_names_the_largest_gains():
    gains = [[6.0, 1.0], [-3.0, 1.0], [0.5, 0.5], [9.0, 6.0]]
    lines = [line(World(1.0, 60, 6, float(reach)), gain) for reach, gain in enumerate(gains)]
    first, second, _ = worth.summary(lines, "coverage", most=2)
    assert "a clear gain in 1 of 4 worlds, a clear loss in 1; at most 2 points either way in 1" in (
        first
    )
    assert "range 3: 50.0 to 59.0, +9.0 ± 6.0 points (all messages +5.0)" in second


def test_worlds_of_a_sweep_differ_in_speed_grid_team_and_range_only():
    base = base_config(["env.horizon=50"])
    config = derived(base, World(1.5, 40, 3, 7.0))
    assert config.fire.head_ros == pytest.approx((0.012, 0.018))
    env = config.env
    assert (env.grid, env.num_uavs, env.radio.range, env.horizon) == ((40, 40), 3, 7.0, 50)
    assert derived(base, World(1.0, 60, 6, 10.0)) == base
    axes = Axes([1.0, 2.0], [30, 60], [2, 4, 6], [5.0, 10.0])
    assert len(set(axes.worlds())) == 24


def test_ranges_in_one_batch_give_what_the_policies_give_one_by_one():
    keys = ("env.horizon=60", "env.radio.loss=0.3", "env.failures=1", "fire.core_radius=[3,4]")
    config = derived(base_config(keys), World(1.0, 20, 4, 7.0))
    together = play_ranges(config, [NO_RADIO, 7.0, NO_LIMITS], 3)
    alone = [
        play_validation(config, policy, 3)
        for policy in ("map_greedy_alone", "map_greedy", "map_greedy_all")
    ]
    assert together == alone
    assert len({tuple(measured["front_age"]) for measured in together}) == 3


def start(folder, *arguments) -> int:
    return main.main(["world", "sweep", str(folder), *SWEPT, *arguments])


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    """Returns the folder of a finished sweep of four worlds."""
    folder = tmp_path_factory.mktemp("sweeps") / "whole"
    assert start(folder) == 0
    return folder


def test_a_sweep_measures_no_gain_out_of_range_and_the_whole_gain_without_limits(swept):
    lines = [json.loads(text) for text in (swept / "worlds.jsonl").read_text().splitlines()]
    assert [(w["speed"], w["range"]) for w in lines] == list(product((1, 2), (0.1, 1000)))
    for deaf, hearing in (lines[:2], lines[2:]):
        assert deaf["gain"] == [0, 0]
        assert deaf["front_age"][1] == deaf["front_age"][2] != deaf["front_age"][3]
        assert deaf["headline"][1] == deaf["headline"][2]
        assert hearing["gain"] == hearing["gain_all"] == deaf["gain_all"]
        assert hearing["headline"][2] == hearing["headline"][3]
    assert (swept / "sweep.png").exists()
    assert not (swept / "lock").exists()


def test_a_stopped_sweep_is_resumed_bit_for_bit(swept, tmp_path, monkeypatch, capsys):
    append, written = SweepFolder.append, []

    def stop(folder, world, values):
        if len(written) == 3:
            raise KeyboardInterrupt
        written.append(world)
        append(folder, world, values)

    monkeypatch.setattr(SweepFolder, "append", stop)
    folder = tmp_path / "stopped"
    assert start(folder) == main.INTERRUPTED
    with (folder / "worlds.jsonl").open("a") as file:
        file.write('{"speed": 2.0, "gr')
    monkeypatch.setattr(SweepFolder, "append", append)
    capsys.readouterr()
    assert start(folder) == 0
    assert "4 worlds, of which 3 are done" in capsys.readouterr().out
    for name in ("worlds.jsonl", "sweep.json"):
        assert (folder / name).read_bytes() == (swept / name).read_bytes()


@pytest.mark.drawn
def test_the_figure_shows_clear_gains_as_colours_and_noise_as_grey(tmp_path):
    axes = Axes([1.0], [60], [6, 12], [5.0, 10.0])
    lines = [line(world, [8.0, 1.0]) for world in axes.worlds()]
    noise = [line(world, [8.0, 9.0], full=(8.0, 9.0)) for world in axes.worlds()]
    for name, part in (("clear", lines), ("noise", noise)):
        sweep_figure(tmp_path / name, part, axes, "coverage", "a title")
    clear, unclear = (_colours(tmp_path / name) for name in ("clear", "noise"))
    grey = tuple(round(255 * part) for part in plot._UNCLEAR[:3])
    assert grey in unclear - clear
    assert any(blue > red + 50 for red, _, blue in clear - unclear)


def _colours(path) -> set[tuple[int, int, int]]:
    """Returns the colours that many pixels have."""
    with Image.open(path) as picture:
        counted = picture.convert("RGB").getcolors(1 << 24)
    return {colour for count, colour in counted if count > 1000}


def refused(capsys, *arguments) -> str:
    """Runs a command that ends at status 2 and returns its message of one line."""
    capsys.readouterr()
    try:
        status = main.main(["world", *map(str, arguments)])
    except SystemExit as ended:
        status = ended.code
    err = capsys.readouterr().err
    assert status == 2
    assert err.count("\n") == 1, err
    return err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["mars"], "world 'mars' is not known; known: blackout, file"),
        (["front", "fire.burn_tim=90"], "key 'fire.burn_tim' is not known"),
        (["front", "fire.burn_time=0.5"], "fire.burn_time=0.5: should be greater than"),
        (["front", "evaluation.scripted=[oracle]"], "front: evaluation.scripted lacks random_way"),
        (["paper"], "evaluation.scripted lacks map_greedy_alone, map_greedy_all"),
        (["front", "evaluation.headline=front_age"], "front_age is not a share in %; known: cov"),
        (["world=front"], "the worlds are given without a key"),
        (["file"], "fire.path=null: a file is needed"),
        (["front", "--fires", "0"], "'0' is not a whole number"),
        (["front", "--json", "out.txt"], "must end in .json"),
    ],
)
def test_bad_input_of_check(arguments, message, capsys):
    assert message in refused(capsys, "check", *arguments)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["env.num_uavs=3"], "env.num_uavs is an axis of the sweep; give its values with --teams"),
        (["fire=reaction"], "fire=reaction: a sweep needs fires with fire.head_ros"),
        (["--grids", "60,4"], "env.grid"),
        (["--grids", "30.5"], "'30.5' is not a list of whole numbers above 0"),
        (["--speeds", "0"], "'0' is not a list of numbers above 0"),
        (["--fires", "1"], "'1' is not a whole number 2 to"),
        (["world=relay"], "env.base=[0.0, 30.0]: a sweep needs a world without a base"),
    ],
)
def test_bad_input_of_sweep(arguments, message, capsys, tmp_path):
    assert message in refused(capsys, "sweep", tmp_path / "new", *arguments)
    assert not (tmp_path / "new").exists()


def test_a_folder_of_something_else_is_left_alone(swept, tmp_path, capsys):
    assert "other settings (validation_fires)" in refused(
        capsys, "sweep", swept, *SWEPT, "--fires", "3"
    )
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.txt").touch()
    message = refused(capsys, "sweep", tmp_path / "full", *SWEPT)
    assert "not empty, and not the folder of a sweep" in message
    (tmp_path / "file").touch()
    assert "cannot be used" in refused(capsys, "sweep", tmp_path / "file", *SWEPT)


def test_nothing_is_written_through_a_link_or_after_a_damaged_line(swept, tmp_path, capsys):
    folder, other = tmp_path / "sweep", tmp_path / "other.jsonl"
    folder.mkdir()
    (folder / "sweep.json").write_bytes((swept / "sweep.json").read_bytes())
    (folder / "worlds.jsonl").symlink_to(other)
    other.write_text("")
    assert "link" in refused(capsys, "sweep", folder, *SWEPT)
    assert other.read_text() == ""
    (folder / "worlds.jsonl").unlink()
    lines = (swept / "worlds.jsonl").read_text().splitlines()
    line = json.loads(lines[0])
    without = {key: value for key, value in line.items() if key != "gain"}
    wrong = [line | {"gain": 5}, line | {"gain": [1, "a"]}, line | {"headline": [1, 2]}]
    for text in ('{"speed": 1}', *map(json.dumps, [without, *wrong]), "[1]"):
        (folder / "worlds.jsonl").write_text(text + "\n")
        message = refused(capsys, "sweep", folder, *SWEPT)
        assert "line 1 is not of a sweep of worlds" in message


def test_two_sweeps_do_not_share_a_folder(swept, capsys):
    lock = Lock(swept, "sweeping")
    try:
        assert "is sweeping here" in refused(capsys, "sweep", swept, *SWEPT)
    finally:
        lock.release()
