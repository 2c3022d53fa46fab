"""Compares `burning_cells` with a direct count."""

import math

import pytest
import torch

from emberlink.envs.world import burning
from emberlink.envs.world.coverage_map import PassedCounts


@pytest.mark.parametrize("chunk", [1, 250, 2**22])
def test_counts_at_every_step(monkeypatch, chunk):
    monkeypatch.setattr(burning, "_CHUNK", chunk)
    generator = torch.Generator().manual_seed(0)
    fires = torch.rand(7, 9, 11, generator=generator) * 60 - 10
    fires[1] = math.inf
    fires[2] = 0
    fires[3, ::2] = math.inf
    fires[4] = fires[4].round()
    horizon = 40
    counts = PassedCounts(fires, horizon)
    which = torch.arange(7)
    for step in range(horizon + 1):
        expected = (fires <= step).sum((1, 2))
        assert counts.at(which, torch.full((7,), step)).equal(expected), step
    assert counts.at(which, torch.full((7,), horizon + 5)).equal(expected)
    order = torch.tensor([[6, 0], [3, 3]])
    steps = torch.tensor([[5, 39], [0, 12]])
    expected = [
        [(fires[f] <= s).sum().item() for f, s in zip(*row, strict=True)]
        for row in zip(order.tolist(), steps.tolist(), strict=True)
    ]
    assert counts.at(order, steps).tolist() == expected
