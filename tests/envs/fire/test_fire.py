"""Tests scenarios, seeds, generated fires and the cached bank."""

import dataclasses
from functools import cache
from pathlib import Path
from typing import Any, get_args

import pytest
import torch
from burning import burning_cells
from pydantic import ValidationError

from emberlink.envs.fire import cache as bank_module
from emberlink.envs.fire.cache import fire_bank
from emberlink.envs.fire.generator import (
    TEST_FROM,
    FireConfig,
    Split,
    fire_seeds,
    load_scenario,
    make_fires,
)

GRID, HORIZON = (30, 30), 1000


def settings_of(**changes: Any) -> dict[str, Any]:
    """Returns the values of `huygens` with changes."""
    return {**dataclasses.asdict(load_scenario("huygens")), **changes}


def test_paper_is_the_measured_fire():
    paper = make_fires(load_scenario("paper"), fire_seeds("train", 1), GRID, HORIZON)
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


def test_huygens_counts():
    test_fires = make_fires(load_scenario("huygens"), fire_seeds("test", 100), GRID, HORIZON)
    count = burning_cells(test_fires, HORIZON)
    start, end = count[:, 0], count[:, -1]
    good = (start >= 60) & (start <= 120) & (end >= 110) & (end <= 190)
    assert good.double().mean() >= 0.95
    assert end.double().std() > 10
    assert len(test_fires.flatten(1).unique(dim=0)) == 100
    edge = torch.cat([test_fires[:, [0, -1]].flatten(1), test_fires[:, :, [0, -1]].flatten(1)], 1)
    assert (edge > 0).all()  # every fire starts in the box
    assert 0.15 < edge.isfinite().any(1).double().mean() < 0.3  # some fronts leave the box


@pytest.mark.parametrize("name", ["huygens", "reaction"])
def test_a_fire_depends_on_its_seed_only(name):
    config, seeds, state = load_scenario(name), fire_seeds("test", 12), torch.get_rng_state()
    fires, some = make_fires(config, seeds, GRID, HORIZON), torch.tensor([9, 0, 4])
    assert torch.equal(make_fires(config, seeds[some], GRID, HORIZON), fires[some])
    assert torch.equal(make_fires(config, seeds[7:8], GRID, HORIZON), fires[7:8])
    assert torch.equal(torch.get_rng_state(), state)
    assert len(fires.flatten(1).unique(dim=0)) == 12


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
    [((60, 60), 30, 0.02), ((45, 30), 30, 0.02), ((15, 15), 30, 0.04)],
)
def test_a_scenario_scales_with_the_shorter_side(grid, fires: int, tolerance: float):
    """Checks that areas scale with the square of min(X, Y)/30 at the start and at the end."""
    scale = (min(grid) / 30) ** 2
    ratio = central_cells(grid, fires) / central_cells(GRID, fires) / scale
    torch.testing.assert_close(ratio, torch.ones(2).double(), rtol=0, atol=tolerance)


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


def test_a_range_begins_with_its_lower_end():
    with pytest.raises(ValidationError, match="head_ros"):
        FireConfig(**settings_of(head_ros=(0.02, 0.01)))


def test_seeds_of_splits_are_disjoint():
    assert fire_seeds("train", 3).tolist() == [0, 1, 2]
    assert fire_seeds("test", 2).tolist() == [TEST_FROM, TEST_FROM + 1]
    every = [fire_seeds(split, TEST_FROM) for split in get_args(Split)]
    assert len(torch.cat(every).unique()) == 3 * TEST_FROM
    assert fire_seeds("test", 2, 1_999_998).tolist() == [1_999_998, 1_999_999]
    with pytest.raises(ValueError, match="1 to 2 seeds"):
        fire_seeds("test", 3, 1_999_998)


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Counts how often fires are computed."""
    made, real = [], bank_module.make_fires

    def counted(config, seeds, grid, horizon):
        made.append(len(seeds))
        return real(config, seeds, grid, horizon)

    monkeypatch.setattr(bank_module, "make_fires", counted)
    return made


def bank(folder: Path, name: str) -> torch.Tensor:
    args = {"split": "train", "count": 2, "grid": (12, 10), "horizon": 50}
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("EMBERLINK_CACHE", str(folder))
        return fire_bank(load_scenario(name), **args)


@pytest.mark.parametrize(("name", "shape"), [("huygens", (2,)), ("reaction", (2, 2))])
def test_a_bank_is_computed_once(name, shape, tmp_path: Path, calls: list[int]):
    first = bank(tmp_path, name)
    assert first.shape == (*shape, 12, 10)
    assert torch.equal(bank(tmp_path, name), first)
    assert calls == [2]
    assert [file.suffix for file in tmp_path.iterdir()] == [".npy"]
    seeds = fire_seeds("train", 2)
    assert torch.equal(first, make_fires(load_scenario(name), seeds, (12, 10), 50))
