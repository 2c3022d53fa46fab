"""Tests `fire=file` from the command line to the evaluation, and the run's copy of its fires."""

import json
import math
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from fire_files import Ellipses, frame_of, points_text, raster_of, write_asc, write_tif
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_run import TINY

from emberlink.configs import known
from emberlink.envs.fire.generator import load_scenario, make_fires, scenarios
from emberlink.envs.fire_files.config import COPY_FILE, FileFireConfig
from emberlink.envs.fire_files.reader import fire_sets, read_fires
from emberlink.envs.scenarios import fires_of
from emberlink.envs.utils.errors import UserError
from emberlink.envs.wildfire import WildfireEnv
from emberlink.trainers.cli import main
from emberlink.trainers.config.compose import from_values, override, resolve, to_values
from emberlink.trainers.runs.run_folder import RunFolder

GRID, HORIZON = (12, 10), 15
SMALL = [*TINY, "env.grid=[12,10]"]


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Path:
    """Returns a raster of a fire."""
    times = raster_of(Ellipses(), 300.0, cells=40, cell=75.0)
    return write_asc(tmp_path_factory.mktemp("source") / "fire.asc", times, 75.0)


@pytest.fixture(scope="module")
def trained(source, tmp_path_factory) -> Path:
    """Trains on a copy of the raster and returns the folder of both."""
    folder = tmp_path_factory.mktemp("trained")
    shutil.copy(source, folder / "fire.asc")
    keys = ["fire=file", f"fire.path={folder}/fire.asc", "fire.units=minutes"]
    assert main.main(["train", "consensus", *SMALL, *keys, f"output={folder}/runs"]) == 0
    return folder


@pytest.fixture
def run(trained, tmp_path) -> Path:
    """Returns a copy of the run."""
    return Path(shutil.copytree(next((trained / "runs").iterdir()), tmp_path / "run"))


def fails(arguments, capfd) -> str:
    """Returns the one-line error of a command that fails."""
    capfd.readouterr()
    assert main.main([str(argument) for argument in arguments]) == 2
    lines = capfd.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    return lines[0]


def bank_of(count, horizon=HORIZON):
    """Returns fires of the generator."""
    return make_fires(load_scenario("huygens"), torch.arange(count), GRID, horizon)


@pytest.mark.parametrize("method", known("method"))
@pytest.mark.parametrize("setup", known("setup"))
def test_every_recipe_accepts_a_file(source, method, setup):
    keys = ["fire=file", f"fire.path={source}", "fire.units=minutes", f"setup={setup}"]
    config = resolve(method, keys, grid=list(GRID), horizon=HORIZON)
    assert config.fire.name == "file"
    assert len(config.fire.sha256) == 64
    env = WildfireEnv(2, config.env, config.fire)
    expected = read_fires(config.fire, GRID, HORIZON)[0]
    env.reset()
    assert torch.equal(env.arrival_time, expected.expand(2, -1, -1))


def test_keys_in_any_order_override_the_setup(source):
    keys = [f"fire.path={source}", "fire.units=minutes", "fire.margin=0.2", "fire=file"]
    assert resolve("consensus", keys).fire.margin == 0.2
    for text, message in (
        ("fire.pth=a", "fire.path"),
        ("fire.units=weeks", "fire.units"),
        ("fire.margin=0.5", "fire.margin"),
        ("fire.ring_width=0", "fire.ring_width"),
        ("fire.start=nan", "fire.start"),
        ("fire.minutes_per_step=-1", "fire.minutes_per_step"),
        ("fire.num_train_fires=3", "fire.num_train_fires"),
        ("fire.kind=spread", "choose it with fire=NAME"),
        ("fire.sha256=abc", "fire.sha256"),
        ("fire.saved_copy=abc", "fire.saved_copy"),
    ):
        with pytest.raises(ValueError, match=message):
            resolve("consensus", [*keys, text])
    with pytest.raises(ValueError, match="end and minutes_per_step"):
        resolve("consensus", [*keys, "fire.end=5", "fire.minutes_per_step=1"])
    with pytest.raises(ValueError, match=r"fire\.path.*not known"):
        resolve("consensus", [f"fire.path={source}"])


def test_a_missing_path_or_file_gives_one_line(capfd, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert "fire.path=null: a file is needed" in fails(["train", "consensus", "fire=file"], capfd)
    for path in ("none.asc", "3mph120deg7hr.asc", "2020.tif", ".", "a folder/x.shp"):
        line = fails(["train", "consensus", "fire=file", f"fire.path={path}"], capfd)
        assert Path(path).name in line
    assert not list(tmp_path.iterdir())


def test_a_run_describes_its_fires(trained):
    (run,) = (trained / "runs").iterdir()
    fire = yaml.safe_load((run / "config.yaml").read_text())["fire"]
    assert fire["path"] == f"{trained}/fire.asc"
    assert len(fire["sha256"]) == 64
    assert "saved_copy" not in fire
    evaluation = json.loads((run / "eval.json").read_text())
    assert set(evaluation["results"]) == {"huygens", "file"}
    assert fire.pop("burn_time") == math.inf  # JSON has no such number
    assert evaluation["held_out"]["file"]["scenario"] == fire
    with np.load(run / COPY_FILE) as kept:
        expected = read_fires(RunFolder(run).config().fire, GRID, HORIZON)
        for split in ("train", "validation", "test"):
            assert np.array_equal(kept[split], expected.numpy())


@pytest.mark.heavy
def test_a_run_is_evaluated_rendered_and_resumed_without_its_file(run, trained, tmp_path, capfd):
    gone = trained / "fire.asc"
    gone.rename(trained / "elsewhere.asc")
    try:
        before = json.loads((run / "eval.json").read_text())["results"]
        assert main.main(["eval", str(run)]) == 0
        assert json.loads((run / "eval.json").read_text())["results"] == before
        assert main.main(["eval", str(run), "env.radio.loss=0.5"]) == 0
        picture = tmp_path / "a.png"
        assert main.main(["render", str(run), "--fire", "file:3", "--output", str(picture)]) == 0
        assert picture.stat().st_size > 1000
        assert main.main(["train", f"resume={run}", "episodes=3"]) == 0
        assert len(RunFolder(run).metrics()) == 3
        # Another grid needs the file.
        line = fails(["eval", run, "env.horizon=9"], capfd)
        assert line.endswith("fire.asc: there is no such file")
        (run / COPY_FILE).write_bytes((run / COPY_FILE).read_bytes()[:300])
        assert fails(["eval", run], capfd).endswith("fire.asc: there is no such file")
    finally:
        (trained / "elsewhere.asc").rename(gone)
    assert main.main(["eval", str(run)]) == 0
    assert (
        json.loads((run / "eval.json").read_text())["results"]["file"].keys()
        == before["file"].keys()
    )


def test_a_changed_file_is_named(run, trained, capfd):
    file = trained / "fire.asc"
    before = file.read_text()
    file.write_text(before.replace("CELLSIZE 75.0", "CELLSIZE 74.0"))
    try:
        (run / COPY_FILE).unlink()
        for arguments in (["eval", run], ["train", f"resume={run}", "episodes=3"]):
            assert "fire.asc: has changed" in fails(arguments, capfd)
    finally:
        file.write_text(before)
    assert main.main(["train", f"resume={run}", "episodes=3"]) == 0


def test_a_copy_of_another_configuration_is_not_used(run, trained):
    config = RunFolder(run).config()
    assert config.fire.saved_copy == str(run / COPY_FILE)
    (trained / "fire.asc").rename(trained / "away.asc")
    try:
        assert fire_sets(config.fire, GRID, HORIZON).train.shape == (1, *GRID)
        changed = override(config, ["env.reward.exit=-3"])
        assert changed.fire.saved_copy == config.fire.saved_copy
        for other in (
            splits_of(config.fire, (10, 12), HORIZON),
            splits_of(config.fire, GRID, HORIZON + 1),
            splits_of(FileFireConfig(**{**vars(config.fire), "margin": 0.2}), GRID, HORIZON),
        ):
            with pytest.raises(ValueError, match="no such file"):
                other()
    finally:
        (trained / "away.asc").rename(trained / "fire.asc")


def splits_of(*arguments):
    return lambda: fire_sets(*arguments)


def test_old_runs_load_unchanged():
    values = to_values(resolve("consensus", ["setup=tuned"]))
    assert "kind" not in values["fire"]
    assert from_values(values) == resolve("consensus", ["setup=tuned"])
    with pytest.raises(ValueError, match=r"^fire\.num_train_fires=0: "):
        from_values({**values, "fire": {**values["fire"], "num_train_fires": 0}})
    with pytest.raises(ValueError, match=r"key 'fire\.kind' is not known"):
        from_values({**values, "fire": {**values["fire"], "kind": "other"}})


@pytest.mark.parametrize(
    ("count", "train", "validation", "test"),
    [
        (1, [0], [0], [0]),
        (2, [0], [0], [1]),
        (3, [0], [1], [2]),
        (5, [0, 1, 2], [3], [4]),
        (12, [0, 1, 2, 5, 6, 7, 10, 11], [3, 8], [4, 9]),
    ],
)
def test_the_fires_of_a_file_are_divided_into_three_sets(count, train, validation, test, tmp_path):
    fires = bank_of(count)
    np.save(tmp_path / "bank.npy", fires.numpy())
    scenario = fires_of(FileFireConfig(path=str(tmp_path / "bank.npy")))
    assert torch.equal(scenario.train(GRID, HORIZON), fires[train])
    assert torch.equal(scenario.validation(7, GRID, HORIZON), fires[(validation * 7)[:7]])
    repeated = (test * 7)[:7]
    assert torch.equal(scenario.test(7, GRID, HORIZON), fires[repeated])
    assert torch.equal(scenario.test_fire(3, GRID, HORIZON), fires[repeated[3:4]])


def test_a_second_file_holds_the_test_fires(tmp_path, source):
    fires = bank_of(7)
    np.save(tmp_path / "bank.npy", fires.numpy())
    config = FileFireConfig(path=str(tmp_path / "bank.npy"), units="minutes", test=str(source))
    scenario = fires_of(config)
    assert torch.equal(scenario.train(GRID, HORIZON), fires[[0, 1, 2, 4, 5, 6]])
    assert torch.equal(scenario.validation(1, GRID, HORIZON), fires[[3]])
    other = read_fires(FileFireConfig(path=str(source), units="minutes"), GRID, HORIZON)
    assert torch.equal(scenario.test(2, GRID, HORIZON), other.expand(2, -1, -1))
    pinned = scenario.with_checksum()
    assert pinned.sha256 != pinned.test_sha256
    with pytest.raises(ValueError, match=r"nothing\.asc: there is no such file"):
        fires_of(FileFireConfig(path=str(source), test="nothing.asc")).with_checksum()


def test_a_bank_is_read_unchanged(tmp_path):
    fires = bank_of(6, 900)
    np.save(tmp_path / "bank.npy", fires.numpy())
    np.save(tmp_path / "double.npy", fires.double().numpy())
    np.save(tmp_path / "one.npy", fires[0].numpy())
    bands = torch.where(fires.isinf(), -9999.0, fires).numpy().transpose(0, 2, 1)[:, ::-1]
    tags = {"tags": {"units": "steps"}, "crs": None}
    write_tif(tmp_path / "bank.tif", bands, **tags)
    write_tif(tmp_path / "one.tif", bands[0].copy(), **tags)
    for name in ("bank.npy", "double.npy", "bank.tif"):
        config = FileFireConfig(path=str(tmp_path / name))
        assert torch.equal(read_fires(config, GRID, 900), fires)
    for name in ("one.npy", "one.tif"):
        config = FileFireConfig(path=str(tmp_path / name))
        assert torch.equal(read_fires(config, GRID, 900), fires[:1])
    config = FileFireConfig(path=str(tmp_path / "bank.npy"))
    early = read_fires(config, GRID, 500)
    assert torch.equal(early, torch.where(fires <= 500, fires, torch.inf))
    stretched = read_fires(
        FileFireConfig(path=str(tmp_path / "bank.npy"), start=0.0, end=900.0),
        GRID,
        1800,
    )
    assert torch.allclose(stretched, fires * 2)


def test_nothing_of_a_stretched_bank_is_burnt_out(tmp_path):
    columns, rows = np.meshgrid(np.arange(30), np.arange(30), indexing="ij")
    far = np.hypot(columns - 15, rows - 15)
    bank = np.where(far <= 12, np.maximum(far - 6, 0) * 100, np.inf).astype(np.float32)
    np.save(tmp_path / "bank.npy", bank[None])
    for keys in ({}, {"end": 1000.0}, {"start": 0.0}):
        config = FileFireConfig(path=str(tmp_path / "bank.npy"), **keys)
        (fire,) = read_fires(config, (30, 30), 1000)
        assert (fire == 0).sum() == (far <= 6).sum()
        assert fire.isfinite().sum() == (far <= 12).sum()


def test_a_bank_on_another_grid_keeps_the_earliest_arrival(tmp_path):
    fires = make_fires(load_scenario("huygens"), torch.arange(3), (24, 20), HORIZON)
    np.save(tmp_path / "bank.npy", fires.numpy())
    got = read_fires(FileFireConfig(path=str(tmp_path / "bank.npy")), GRID, HORIZON)
    assert torch.equal(got, fires.reshape(3, 12, 2, 10, 2).amin((2, 4)))


def test_the_name_of_a_scenario_needs_no_file():
    assert "file" not in scenarios()
    assert "file" in known("fire")
    with pytest.raises(ValueError, match="unknown fire 'file'"):
        WildfireEnv(1, fire="file")


@pytest.mark.parametrize(("suffix", "module"), [("tif", "rasterio"), ("shp", "pyogrio")])
def test_without_the_extra_the_message_names_it(tmp_path, monkeypatch, suffix, module):
    frame_of(Ellipses(), (60.0, 120.0)).to_file(tmp_path / "fire.shp")
    write_tif(tmp_path / "fire.tif", raster_of(Ellipses(), 300.0))
    monkeypatch.setitem(sys.modules, module, None)
    config = FileFireConfig(path=str(tmp_path / f"fire.{suffix}"), units="minutes")
    with pytest.raises(ValueError, match=r"needs the extra geo: pip install '\.\[geo\]'"):
        read_fires(config, GRID, HORIZON)


def test_numpy_and_text_need_no_extra(tmp_path, monkeypatch, source):
    fires = bank_of(2)
    np.save(tmp_path / "bank.npy", fires.numpy())
    (tmp_path / "fire.txt").write_text(points_text(Ellipses(), 6040, points=24))
    for module in ("rasterio", "pyogrio", "geopandas", "shapely", "pyproj", "pandas"):
        monkeypatch.setitem(sys.modules, module, None)
    got = read_fires(FileFireConfig(path=str(tmp_path / "bank.npy")), GRID, HORIZON)
    assert torch.equal(got, fires)
    text = FileFireConfig(path=str(tmp_path / "fire.txt"))
    assert torch.isfinite(read_fires(text, GRID, 1000)).any()
    raster = FileFireConfig(path=str(source), units="minutes")
    assert torch.isfinite(read_fires(raster, GRID, 1000)).any()


@settings(max_examples=80, deadline=None)
@given(
    st.tuples(st.integers(8, 40), st.integers(8, 40)),
    st.integers(1, 2000),
    st.fixed_dictionaries(
        {
            "start": st.none() | st.floats(-100, 400),
            "end": st.none() | st.floats(-100, 400),
            "margin": st.none() | st.floats(0, 0.45),
            "ring_width": st.none() | st.floats(0.01, 30),
        }
    ),
)
def test_any_settings_give_a_grid_or_a_one_line_error(source, grid, horizon, keys):
    config = FileFireConfig(path=str(source), units="minutes", **keys)
    try:
        fire = read_fires(config, grid, horizon)
    except ValueError as error:
        problem = str(error)
    else:
        problem = ""
    if problem:
        assert problem.startswith(f"{source}: from ")
        assert "\n" not in problem
        return
    assert fire.shape == (1, *grid)
    assert (fire >= 0).all()
    assert (fire.isinf() | (fire <= horizon)).all()
    assert fire.isfinite().sum() >= 2


def test_messages_of_libraries_are_one_line(tmp_path, monkeypatch):
    def damaged(path):
        raise UserError("*** in database main ***\nPage 1: \x1b[31mcorruption")

    np.save(tmp_path / "fire.npy", bank_of(1).numpy())
    monkeypatch.setattr("emberlink.envs.fire_files.reader.formats.find_format", damaged)
    with pytest.raises(ValueError, match=r"main \*\*\*\\nPage 1: \\x1b\[31mcorruption$"):
        read_fires(FileFireConfig(path=str(tmp_path / "fire.npy")), GRID, HORIZON)
