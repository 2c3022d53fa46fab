"""Compares front points in the paper's text format with the paper's rule, cell by cell."""

import math

import numpy as np
import pytest
import torch

from emberlink.envs.fire_files.config import FileFireConfig
from emberlink.envs.fire_files.reader import read_fires


def read(path, grid=(30, 30), horizon=1000, **keys):
    (fire,) = read_fires(FileFireConfig(path=str(path), **keys), grid, horizon)
    return fire


def stamped(lines):
    """Computes the same arrival times cell by cell; line 6000 is step 0."""
    arrival = [[math.inf] * 30 for _ in range(30)]
    for step, line in enumerate(lines[6000:]):
        numbers = [float(text) for text in line.split(",") if text]
        for x, y in zip(numbers[::3], numbers[1::3], strict=True):
            i, j = int(x - 29 / 3), int(y - 29 / 3)
            for u, v in ((i, j), (i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)):
                if 0 <= u < 30 and 0 <= v < 30:
                    arrival[u][v] = min(arrival[u][v], step)
    return torch.tensor(arrival)


def test_a_plus_by_hand(tmp_path):
    # 20.5 - 29/3 = 10.83: cell 10; 12.0 - 29/3 = 2.33: cell 2.
    lines = ["1,1,1,"] * 6000 + ["20.5,12.0,0.7,", "20.5,12.0,0.7,30.0,12.0,0.7,"]
    path = tmp_path / "fire.txt"
    path.write_text("\n".join(lines))
    fire = read(path)
    burning = {tuple(at) for at in torch.nonzero(fire == 0).tolist()}
    assert burning == {(10, 2), (9, 2), (11, 2), (10, 1), (10, 3)}
    later = {tuple(at) for at in torch.nonzero(fire == 1).tolist()}
    assert later == {(20, 2), (19, 2), (21, 2), (20, 1), (20, 3)}
    assert torch.isfinite(fire).sum() == 10


@pytest.mark.parametrize("name", ["fire.txt", "fire.csv", "fire", "fire.log"])
def test_random_fronts(tmp_path, name):
    random = np.random.default_rng(1)
    lines = [
        "".join(f"{x:.4f},{y:.4f},1.0," for x, y in random.uniform(3, 45, (3, 2)))
        for _ in range(6040)
    ]
    path = tmp_path / name
    path.write_text("\n".join([*lines, ""]))
    assert torch.equal(read(path), stamped(lines))
    assert (read(path, horizon=20)[stamped(lines) > 20] == math.inf).all()


def test_other_grids_and_spans(tmp_path):
    lines = ["20,20,1,"] * 6000 + [f"{20 + k / 2},20,1," for k in range(21)]
    path = tmp_path / "fire.txt"
    path.write_text("\n".join(lines))
    plain = read(path)
    fine = read(path, (60, 60))
    coarse = read(path, (15, 15))
    assert torch.equal(coarse, plain.reshape(15, 2, 15, 2).amin((1, 3)))
    assert torch.isfinite(fine).sum() == 4 * torch.isfinite(plain).sum()
    half = read(path, horizon=100, end=10.0, ring_width=None)
    # 10 lines fill 100 steps.
    assert torch.equal(torch.isfinite(half), plain <= 10)
    assert torch.equal(half[plain <= 10], plain[plain <= 10] * 10)
    seconds = read(path, horizon=100, units="seconds", minutes_per_step=0.1 / 60, ring_width=None)
    assert torch.equal(seconds, half)
