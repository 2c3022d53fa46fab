"""Tests scenarios, seeds, generated fires and the cached bank."""

import dataclasses
import math
import re
import warnings
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import torch
from burning import burning_cells
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from emberlink.envs.fire import cache as bank_module
from emberlink.envs.fire.cache import bank_key, cache_folder, fire_bank
from emberlink.envs.fire.generator import (
    TEST_FROM,
    FireConfig,
    Split,
    fire_seeds,
    load_scenario,
    make_fires,
    scenarios,
)

GRID, HORIZON = (30, 30), 1000
RANGES = [
    f.name
    for f in dataclasses.fields(FireConfig)
    if f.name not in {"name", "num_train_fires", "two_sided", "burn_time", "lengths"}
]


def settings_of(**changes: Any) -> dict[str, Any]:
    """Returns the values of `huygens` with changes."""
    return {**dataclasses.asdict(load_scenario("huygens")), **changes}


def test_every_file_is_a_scenario_with_its_name():
    files = resources.files("emberlink.configs").joinpath("fire").iterdir()
    names = sorted(Path(str(file)).stem for file in files)
    generated = [name for name in names if name != "file"]
    assert scenarios() == generated
    assert {"huygens", "oil_slick", "paper"} <= set(names)
    assert [load_scenario(name).name for name in generated] == generated


def test_unknown_scenario_lists_the_known_ones():
    with pytest.raises(ValueError, match=r"'papr'.*huygens.*paper"):
        load_scenario("papr")
    with pytest.raises(ValueError, match="unknown fire"):
        load_scenario("../fire/paper")


def test_a_wrong_value_in_a_file_of_ones_own_names_that_file(tmp_path, monkeypatch):
    (tmp_path / "fire").mkdir()
    file = tmp_path / "fire" / "mine.yaml"
    text = resources.files("emberlink.configs").joinpath("fire", "huygens.yaml").read_text()
    file.write_text(re.sub("head_ros: .*", "head_ros: [1, 600]", text))
    monkeypatch.setenv("EMBERLINK_CONFIGS", str(tmp_path))
    with pytest.raises(ValueError, match=rf"^{re.escape(str(file))}: head_ros"):
        load_scenario("mine")


@pytest.fixture(scope="module")
def paper() -> torch.Tensor:
    return make_fires(load_scenario("paper"), fire_seeds("train", 1), GRID, HORIZON)


@pytest.fixture(scope="module")
def test_fires() -> torch.Tensor:
    return make_fires(load_scenario("huygens"), fire_seeds("test", 200), GRID, HORIZON)


def test_paper_is_the_measured_fire(paper: torch.Tensor):
    count = burning_cells(paper, HORIZON)[0]
    assert (int(count[0]), int(count[-1])) == (77, 141)
    assert (count.diff() >= 0).all()
    burning = paper[0].isfinite().nonzero()
    assert burning[:, 1].max() < 18  # the lower half and its growth
    x, y = torch.meshgrid(torch.arange(30.0), torch.arange(30.0), indexing="ij")
    away = torch.hypot(x - 0.36 * 29, y - 0.29 * 29)
    assert int((away <= 5.75).sum()) == 107
    assert torch.equal(paper[0] == 0, (away <= 5.75) & (away >= 3.0))
    assert paper[0][away < 3].isinf().all()
    start, end = ((paper[0] <= t).nonzero().float() for t in (0, HORIZON))
    grown = end.amax(0) - start.amax(0), start.amin(0) - end.amin(0)
    assert [g.tolist() for g in grown] == [[4, 1], [0, 1]]  # towards +x and not upwind


def test_paper_is_one_fire(paper: torch.Tensor):
    seeds = torch.tensor([3, 77, TEST_FROM + 5])
    assert torch.equal(
        make_fires(load_scenario("paper"), seeds, GRID, HORIZON), paper.expand(3, -1, -1)
    )


def test_huygens_counts(test_fires: torch.Tensor):
    count = burning_cells(test_fires, HORIZON)
    start, end = count[:, 0], count[:, -1]
    good = (start >= 60) & (start <= 120) & (end >= 110) & (end <= 190)
    assert good.double().mean() >= 0.95
    assert end.double().std() > 10
    assert len(test_fires.flatten(1).unique(dim=0)) == 200
    edge = torch.cat([test_fires[:, [0, -1]].flatten(1), test_fires[:, :, [0, -1]].flatten(1)], 1)
    assert (edge > 0).all()  # every fire starts in the box
    assert 0.15 < edge.isfinite().any(1).double().mean() < 0.3  # some fronts leave the box


def test_a_fire_depends_on_its_seed_only(test_fires: torch.Tensor):
    config, seeds = load_scenario("huygens"), fire_seeds("test", 200)
    some = torch.tensor([150, 0, 7])
    state = torch.get_rng_state()
    assert torch.equal(make_fires(config, seeds[some], GRID, HORIZON), test_fires[some])
    assert torch.equal(make_fires(config, seeds[7:8], GRID, HORIZON), test_fires[7:8])
    assert torch.equal(torch.get_rng_state(), state)


def test_no_fire_is_in_both_splits(test_fires: torch.Tensor):
    train = make_fires(load_scenario("huygens"), fire_seeds("train", 50), GRID, HORIZON)
    both = torch.cat([train, test_fires[:50]]).flatten(1)
    assert len(both.unique(dim=0)) == 100


def test_a_longer_horizon_continues_the_same_fire(test_fires: torch.Tensor):
    seeds = fire_seeds("test", 5)
    short = make_fires(load_scenario("huygens"), seeds, GRID, 400)
    assert torch.equal(short, test_fires[:5].masked_fill(test_fires[:5] > 400, math.inf))


def test_arrivals(test_fires: torch.Tensor):
    assert test_fires.dtype == torch.float32
    finite = test_fires[test_fires.isfinite()]
    assert finite.min() == 0
    assert finite.max() <= HORIZON
    assert not test_fires.isnan().any()


def test_burning_cells_by_hand():
    arrival = torch.tensor([[[0.0, 0.5], [2.0, math.inf]], [[3.0, 3.1], [0.0, 0.0]]])
    assert burning_cells(arrival, 3).tolist() == [[1, 2, 3, 3], [2, 2, 2, 3]]


def test_fuel_slows_the_front():
    even = FireConfig(**settings_of(fuel_patches=(0, 0)))
    slow = FireConfig(**settings_of(fuel_patches=(4, 4), patch_rate=(0.0, 0.0)))
    seeds = fire_seeds("train", 20)
    fast, slowed = (make_fires(c, seeds, GRID, HORIZON) for c in (even, slow))
    assert torch.equal(fast == 0, slowed == 0)
    few, many = (burning_cells(fires, HORIZON) for fires in (slowed, fast))
    assert (few <= many + 1).all()
    assert (many - few)[:, -1].double().mean() > 5


@cache
def central_cells(grid: tuple[int, int], fires: int) -> torch.Tensor:
    """Returns the burning cells of some fires in the middle, at the start and at the end."""
    config = FireConfig(**settings_of(centre_x=(0.45, 0.55), centre_y=(0.45, 0.55)))
    grown = make_fires(config, fire_seeds("train", fires), grid, HORIZON)
    return burning_cells(grown, HORIZON)[:, [0, -1]].double().sum(0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("grid", "fires", "tolerance"),
    [
        ((60, 60), 60, 0.01),
        ((45, 30), 60, 0.015),
        ((128, 128), 12, 0.012),
        ((15, 15), 60, 0.03),
        ((8, 20), 60, 0.08),  # a ring of about five cells, with coarse edges
        ((8, 8), 60, 0.11),
    ],
)
def test_a_scenario_scales_with_the_shorter_side(grid, fires: int, tolerance: float):
    """Checks that areas scale with the square of min(X, Y)/30 at the start and at the end."""
    scale = (min(grid) / 30) ** 2
    ratio = central_cells(grid, fires) / central_cells(GRID, fires) / scale
    torch.testing.assert_close(ratio, torch.ones(2).double(), rtol=0, atol=tolerance)


def test_the_centre_is_a_fraction_of_the_box():
    still = settings_of(
        azimuth=(0, 0), wind_shift=(0, 0), fuel_patches=(0, 0), length_to_breadth=(1, 1)
    )
    config = FireConfig(**{**still, "centre_x": (0.5, 0.5), "centre_y": (0.4, 0.4)})
    arrival = make_fires(config, fire_seeds("train", 1), (61, 31), HORIZON)[0]
    burning = arrival.isfinite().nonzero().double()
    torch.testing.assert_close(
        burning.mean(0), torch.tensor([30.0, 12.0]).double(), rtol=0, atol=0.1
    )


def test_the_wind_is_in_degrees_and_turns_with_time():
    still = settings_of(centre_x=(0.5, 0.5), centre_y=(0.5, 0.5), fuel_patches=(0, 0))
    for azimuth, turning, want in (
        (90, 0, (0, 1)),
        (180, 0, (-1, 0)),
        (0, 90, (1, 1)),
        (0, -90, (1, -1)),
    ):
        fixed = {"azimuth": (azimuth, azimuth), "wind_shift": (turning, turning)}
        config = FireConfig(**{**still, **fixed})
        arrival = make_fires(config, fire_seeds("train", 1), (31, 31), HORIZON)[0]
        drift = arrival.isfinite().nonzero().double().mean(0) - 15
        drift = drift / drift.norm()
        torch.testing.assert_close(
            drift,
            torch.nn.functional.normalize(torch.tensor(want).double(), dim=0),
            rtol=0,
            atol=0.12,
        )


@pytest.mark.parametrize("grid", [(7, 30), (30, 257)])
def test_grid_out_of_range(grid: tuple[int, int]):
    with pytest.raises(ValueError, match=r"8 to 256 .*\("):
        make_fires(load_scenario("paper"), fire_seeds("train", 1), grid, 10)


def test_seeds_of_splits_are_disjoint():
    assert fire_seeds("train", 3).tolist() == [0, 1, 2]
    assert fire_seeds("test", 2).tolist() == [TEST_FROM, TEST_FROM + 1]
    every = [fire_seeds(split, TEST_FROM) for split in get_args(Split)]
    assert len(torch.cat(every).unique()) == 3 * TEST_FROM


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (("test", TEST_FROM + 1), "1000001"),
        (("train", TEST_FROM + 1), "1000001"),
        (("train", 0), "got 0"),
        (("heldout", 1), "'heldout'; known: train, validation, test"),
    ],
)
def test_seed_errors(args, message: str):
    with pytest.raises(ValueError, match=message):
        fire_seeds(*args)


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Counts how often fires are computed."""
    made, real = [], bank_module.make_fires

    def counted(config, seeds, grid, horizon, device=None):
        made.append(len(seeds))
        return real(config, seeds, grid, horizon, device)

    monkeypatch.setattr(bank_module, "make_fires", counted)
    return made


def bank(folder, **changes) -> torch.Tensor:
    args = {"split": "train", "count": 2, "grid": (12, 10), "horizon": 50, **changes}
    with pytest.MonkeyPatch.context() as patch:
        if folder is not None:
            patch.setenv("EMBERLINK_CACHE", str(folder))
        return fire_bank(load_scenario("huygens"), **args)


def test_a_bank_is_computed_once(tmp_path: Path, calls: list[int]):
    first = bank(tmp_path)
    assert first.shape == (2, 12, 10)
    assert torch.equal(bank(tmp_path), first)
    assert calls == [2]
    assert [file.suffix for file in tmp_path.iterdir()] == [".npy"]
    seeds = fire_seeds("train", 2)
    assert torch.equal(first, make_fires(load_scenario("huygens"), seeds, (12, 10), 50))


def _truncate(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:-40])


def _other_shape(file: Path) -> None:
    np.save(file, np.zeros((2, 10, 12), np.float32))


def _other_type(file: Path) -> None:
    np.save(file, np.zeros((2, 12, 10)))


def _pickle(file: Path) -> None:
    np.save(file, np.array([[{}]], dtype=object), allow_pickle=True)


DAMAGE = [
    _truncate,
    _other_shape,
    _other_type,
    _pickle,
    lambda file: file.write_bytes(b""),
    lambda file: file.write_bytes(b"PK\x03\x04 not a zip file"),
    lambda file: file.write_bytes(b"\x93NUMPY\x01\x00\x10\x00" + b"{" * 16),
]


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_file_is_replaced(tmp_path: Path, calls: list[int], damage):
    first = bank(tmp_path)
    damage(next(tmp_path.iterdir()))
    assert torch.equal(bank(tmp_path), first)
    assert torch.equal(bank(tmp_path), first)
    assert calls == [2, 2]
    assert len(list(tmp_path.iterdir())) == 1


def test_a_folder_that_cannot_be_written_to_is_no_error(tmp_path: Path, calls: list[int]):
    occupied = tmp_path / "file"
    occupied.write_text("")
    with pytest.warns(UserWarning, match="not cached"):
        fires = bank(occupied / "cache")
    assert fires.shape == (2, 12, 10)
    assert calls == [2]


def test_the_cache_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.delenv("EMBERLINK_CACHE", raising=False)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    assert cache_folder() == tmp_path / ".cache" / "emberlink"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert cache_folder() == tmp_path / "xdg" / "emberlink"
    monkeypatch.setenv("EMBERLINK_CACHE", str(tmp_path / "own"))
    assert cache_folder() == tmp_path / "own"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        bank(None)
    assert len(list((tmp_path / "own").iterdir())) == 1


def test_the_cache_key_depends_on_every_setting(monkeypatch: pytest.MonkeyPatch):
    base = settings_of()
    args = {"split": "train", "count": 2, "grid": (12, 10), "horizon": 50}

    def key(config=base, **changes):
        return bank_key(FireConfig(**config), **{**args, **changes})

    keys = [key(), key(split="test"), key(count=3), key(grid=(10, 12)), key(horizon=51)]
    keys += [key({**base, "name": "other"}), key({**base, "num_train_fires": 3})]
    keys += [key({**base, "two_sided": True}), key({**base, "lengths": "cells"})]
    # Burn-out is computed from the arrival times in a bank.
    assert key({**base, "burn_time": 3.0}) == keys[0]
    for field in RANGES:
        low, high = base[field]
        more = 1 if field == "fuel_patches" else 0.001
        other = (low, low) if low < high else (low, high + more)
        keys.append(key({**base, field: other}))
    monkeypatch.setattr(bank_module, "GENERATOR_VERSION", 999)
    keys.append(key())
    assert len(set(keys)) == len(keys) == 10 + len(RANGES)


@pytest.mark.parametrize("field", RANGES)
def test_ranges_are_checked(field: str):
    good = load_scenario("huygens")
    low, high = getattr(good, field)
    as_list = FireConfig(**settings_of(**{field: [low, high]}))
    assert as_list == good
    assert isinstance(getattr(as_list, field), tuple)
    for bad in (
        (high, low),
        (low,),
        (low, high, high),
        low,
        (low, 1e9),
        (-1e9, high),
        (low, "1"),
        None,
    ):
        if bad == (low, high):
            continue
        with pytest.raises(ValidationError, match=field):
            FireConfig(**settings_of(**{field: bad}))
    for bad in (math.nan, math.inf):
        with pytest.raises(ValidationError, match=field):
            FireConfig(**settings_of(**{field: (low, bad)}))


def test_a_config_is_frozen_complete_and_closed():
    config = load_scenario("paper")
    with pytest.raises(dataclasses.FrozenInstanceError):
        config.num_train_fires = 3  # pyright: ignore[reportAttributeAccessIssue]
    with pytest.raises(ValidationError, match="wind"):
        FireConfig(**settings_of(wind=3))
    with pytest.raises(ValidationError, match="num_train_fires"):
        FireConfig(**settings_of(num_train_fires=0))
    with pytest.raises(ValidationError, match="num_train_fires"):
        FireConfig(**settings_of(num_train_fires="4"))
    missing = settings_of()
    del missing["wind_shift"]
    with pytest.raises(ValidationError, match="wind_shift"):
        FireConfig(**missing)


@settings(max_examples=25, deadline=None)
@given(
    low=st.floats(1e-6, 1),
    high=st.floats(1e-6, 1),
    ratio=st.floats(1, 8),
    radius=st.floats(0.05, 30),
    patches=st.integers(0, 32),
    seed=st.integers(0, 2**40),
)
def test_every_valid_config_gives_a_fire(low, high, ratio, radius, patches, seed):
    values = settings_of(
        head_ros=(low, high),
        length_to_breadth=(1, ratio),
        core_radius=(radius, radius),
        fuel_patches=(0, patches),
    )
    if low > high:
        with pytest.raises(ValidationError, match="head_ros"):
            FireConfig(**values)
        return
    arrival = make_fires(FireConfig(**values), torch.tensor([seed]), (8, 9), 20)
    assert arrival.shape == (1, 8, 9)
    assert (arrival >= 0).all()
    assert ((arrival <= 20) | arrival.isinf()).all()


def test_the_smallest_patch_gives_no_nan():
    """The squared radius underflows to 0, and so does the squared distance at a cell's centre."""
    config = dataclasses.replace(
        load_scenario("paper"),
        patch_radius=(1e-30, 1e-30),
        patch_distance=(-5.75, -5.75),
        centre_x=(0.5, 0.5),
        centre_y=(0.5, 0.5),
    )
    fires = make_fires(config, fire_seeds("train", 1), (31, 31), 50)
    assert not fires.isnan().any()
