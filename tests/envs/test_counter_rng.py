"""Tests random numbers from keys: distribution, independence, reproducibility."""

import math

import pytest
import torch

from emberlink.envs.utils import counter_rng
from emberlink.envs.world import motion

COUNT = 20_000


def test_uniform_distribution():
    draws = counter_rng.uniform(torch.tensor([1, -5, 2**60]), COUNT).double()
    assert ((draws > 0) & (draws < 1)).all()
    # Five standard errors of the mean, the variance and each of ten bins.
    assert (draws.mean(-1) - 0.5).abs().max() < 5 * math.sqrt(1 / 12 / COUNT)
    assert (draws.var(-1) - 1 / 12).abs().max() < 5 * math.sqrt(1 / 180 / COUNT)
    bins = torch.stack([torch.histc(row, 10, 0, 1) for row in draws]) / COUNT
    assert (bins - 0.1).abs().max() < 5 * math.sqrt(0.09 / COUNT)


def test_normal_distribution():
    draws = counter_rng.normal(torch.tensor([3, 4]), COUNT).double()
    assert draws.isfinite().all()
    assert draws.mean(-1).abs().max() < 5 / math.sqrt(COUNT)
    assert (draws.var(-1) - 1).abs().max() < 5 * math.sqrt(2 / COUNT)
    assert (draws.pow(4).mean(-1) - 3).abs().max() < 5 * math.sqrt(96 / COUNT)


def test_random_points_fill_the_box():
    low, high = torch.tensor([0.0, 0, 1]).double(), torch.tensor([29.0, 19, 4]).double()
    points = motion.random_points(torch.arange(500), 4, low, high)
    assert points.shape == (500, 4, 3)
    assert points.dtype == torch.float32
    flat = points.flatten(0, 1).double()
    assert ((flat >= low) & (flat <= high)).all()
    assert torch.allclose(flat.mean(0), (low + high) / 2, rtol=0.04)
    assert torch.allclose(flat.std(0), (high - low) / math.sqrt(12), rtol=0.04)


def correlation(a: torch.Tensor, b: torch.Tensor) -> float:
    return torch.corrcoef(torch.stack((a.flatten(), b.flatten())).double())[0, 1].item()


@pytest.mark.parametrize("seed", [0, 12345])
def test_neighbouring_draws_are_uncorrelated(seed):
    limit = 5 / math.sqrt(COUNT)
    envs = counter_rng.uniform(counter_rng.seed_keys(seed, 3), COUNT)
    assert abs(correlation(envs[0], envs[1])) < limit
    assert abs(correlation(envs[0], envs[2])) < limit
    # The same position in different environments, episodes and seeds.
    column = counter_rng.uniform(counter_rng.seed_keys(seed, COUNT), 2)
    assert abs(correlation(column[:, 0], column[:, 1])) < limit
    assert abs(correlation(column[1:, 0], column[:-1, 0])) < limit
    key = counter_rng.seed_keys(seed, 1)
    episodes = counter_rng.uniform(counter_rng.fold_in(key, torch.arange(COUNT)), 1)
    assert abs(correlation(episodes[1:], episodes[:-1])) < limit
    others = counter_rng.uniform(counter_rng.seed_keys(seed + 1, 3), COUNT)
    assert abs(correlation(envs[0], others[0])) < limit
    assert abs(correlation(envs[1], others[0])) < limit  # also if shifted by one


def test_keys_do_not_collide():
    every = [counter_rng.seed_keys(seed, 1000) for seed in range(20)]
    folds = [counter_rng.fold_in(every[0], counter) for counter in range(20)]
    twice = [counter_rng.fold_in(folds[0], counter) for counter in range(3)]
    together = torch.cat(every + folds + twice)
    assert len(together.unique()) == len(together)


def test_a_draw_is_a_function_of_its_key():
    key = counter_rng.seed_keys(9, 4)
    torch.manual_seed(0)
    first = counter_rng.uniform(key, 5)
    torch.manual_seed(1)
    assert torch.equal(counter_rng.uniform(key, 5), first)
    assert torch.equal(counter_rng.uniform(key, 50)[:, :5], first)
    assert torch.equal(counter_rng.uniform(key[2], 5), first[2])
    assert torch.equal(counter_rng.uniform(key.view(2, 2), 5).view(4, 5), first)


def test_values_equal_splitmix64():
    """The reference is SplitMix64 in Python's unbounded integers."""

    def mix(x: int) -> int:
        x = (x ^ x >> 30) * 0xBF58476D1CE4E5B9 % 2**64
        x = (x ^ x >> 27) * 0x94D049BB133111EB % 2**64
        return x ^ x >> 31

    golden = 0x9E3779B97F4A7C15
    for key, counter in [(0, 0), (1, 2), (-3, 4), (2**62, 2**40)]:
        expected = mix((mix((key + golden) % 2**64) + (counter + 1) * golden) % 2**64)
        got = counter_rng.fold_in(torch.tensor(key), counter).item()
        assert got % 2**64 == expected
