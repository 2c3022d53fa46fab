"""Tests `fire=file` in a training, the three sets, a run's copy of its fires, banks, the text."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from fire_files import Ellipses, fires_in, raster_of, write_asc
from tiny_run import TINY

from emberlink.envs.fire.generator import load_scenario, make_fires
from emberlink.envs.fire_files.config import COPY_FILE, FileFireConfig
from emberlink.envs.fire_files.reader import fire_sets, save_copy, with_checksum
from emberlink.envs.scenarios import fires_of
from emberlink.trainers.cli import main

GRID, HORIZON = (12, 10), 15


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Path:
    times = raster_of(Ellipses(), 300.0, cells=40, cell=75.0)
    return write_asc(tmp_path_factory.mktemp("source") / "fire.asc", times, 75.0)


def bank_of(count, horizon=HORIZON):
    seeds = torch.arange(count)
    return make_fires(load_scenario("huygens"), seeds, GRID, horizon)


@pytest.mark.heavy
def test_a_run_says_what_it_read_and_is_evaluated_without_its_file(source, tmp_path, capsys):
    path = tmp_path / "fire.asc"
    path.write_bytes(source.read_bytes())
    keys = ["fire=file", f"fire.path={path}", "fire.units=minutes", "env.grid=[12,10]"]
    assert main.main(["train", "consensus", *TINY, *keys, f"output={tmp_path}/runs"]) == 0
    out = capsys.readouterr().out
    assert "read: " in out
    assert "1 place where it begins" in out
    path.unlink()
    (run,) = (tmp_path / "runs").iterdir()
    assert main.main(["eval", str(run)]) == 0
    capsys.readouterr()
    assert main.main(["eval", str(run), "env.horizon=9"]) == 2
    assert capsys.readouterr().err.strip().endswith("fire.asc: No such file or directory")


def test_a_copy_is_used_for_its_own_grid_only_and_a_changed_file_is_named(source, tmp_path):
    path = tmp_path / "fire.asc"
    path.write_bytes(source.read_bytes())
    config = with_checksum(FileFireConfig(path=str(path), units="minutes"))
    save_copy(config, tmp_path, GRID, HORIZON)
    config = dataclasses.replace(config, saved_copy=str(tmp_path / COPY_FILE))
    expected = fire_sets(config, GRID, HORIZON)
    path.write_text(path.read_text().replace("-9999.0", "-9999.00"))
    assert torch.equal(fire_sets(config, GRID, HORIZON).train, expected.train)
    for changed, grid in ((config, (10, 12)), (dataclasses.replace(config, margin=0.2), GRID)):
        with pytest.raises(ValueError, match=r"fire\.asc: has changed"):
            fire_sets(changed, grid, HORIZON)
    (tmp_path / COPY_FILE).write_bytes(b"damaged")
    with pytest.raises(ValueError, match=r"fire\.asc: has changed"):
        fire_sets(config, GRID, HORIZON)


@pytest.mark.parametrize(
    ("count", "train", "validation", "test"),
    [
        (1, [0], [0], [0]),
        (3, [0], [1], [2]),
        (5, [0, 1, 2], [3], [4]),
        (12, [0, 1, 2, 5, 6, 7, 10, 11], [3, 8], [4, 9]),
    ],
)
def test_fires_are_divided_into_three_sets(count, train, validation, test, tmp_path, source):
    fires = bank_of(count)
    np.save(tmp_path / "bank.npy", fires.numpy())
    scenario = fires_of(FileFireConfig(path=str(tmp_path / "bank.npy")))
    assert torch.equal(scenario.fires("train", None, GRID, HORIZON), fires[train])
    assert torch.equal(scenario.fires("validation", 7, GRID, HORIZON), fires[(validation * 7)[:7]])
    assert torch.equal(scenario.fires("test", 7, GRID, HORIZON), fires[(test * 7)[:7]])
    # A second file holds the test fires.
    config = dataclasses.replace(scenario.config, test=str(source), units="minutes")
    sets = fire_sets(config, GRID, HORIZON)
    assert len(sets.train) + len(sets.validation) == max(count, 2)
    other = FileFireConfig(path=str(source), units="minutes")
    assert torch.equal(sets.test, fires_in(other, GRID, HORIZON))


def test_a_bank_is_read_unchanged(tmp_path):
    fires = bank_of(6, 900)
    np.save(tmp_path / "bank.npy", fires.numpy())
    np.save(tmp_path / "double.npy", fires.double().numpy())
    for name in ("bank.npy", "double.npy"):
        config = FileFireConfig(path=str(tmp_path / name))
        assert torch.equal(fires_in(config, GRID, 900), fires)
    early = fires_in(config, GRID, 500)
    assert torch.equal(early, torch.where(fires <= 500, fires, torch.inf))
    stretched = FileFireConfig(path=config.path, start=0.0, end=900.0)
    assert torch.allclose(fires_in(stretched, GRID, 1800), fires * 2)
    with pytest.raises(ValueError, match=r"double\.npy: fire\.units=minutes"):
        fires_in(FileFireConfig(path=config.path, units="minutes"), GRID, 900)


def test_random_fronts_of_the_papers_text(tmp_path):
    random = np.random.default_rng(1)
    steps = [random.uniform(3, 45, (3, 2)) for _ in range(6040)]
    expected = torch.full((30, 30), math.inf)
    for step, points in enumerate(steps[6000:]):
        for x, y in points:
            i, j = int(x - 29 / 3), int(y - 29 / 3)
            for u, v in ((i, j), (i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)):
                if 0 <= u < 30 and 0 <= v < 30:
                    expected[u, v] = min(expected[u, v], step)
    path = tmp_path / "fire"
    path.write_text("\n".join("".join(f"{x!r},{y!r},1.0," for x, y in p.tolist()) for p in steps))
    (fire,) = fires_in(FileFireConfig(path=str(path)), (30, 30), 1000)
    assert torch.equal(fire, expected)
    path.write_text("\n".join([*["1,1,1,"] * 6000, "1,2,", "3,4,5,"]))
    with pytest.raises(ValueError, match="expected x,y,intensity, of points in line 6001"):
        fires_in(FileFireConfig(path=str(path)), (30, 30), 1000)
