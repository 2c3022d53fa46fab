"""Tests the measures on hand-written episodes."""

import pytest
import torch

from emberlink.envs import WildfireConfig, WildfireEnv, keys, metrics
from emberlink.trainers import make_env


def test_what_the_base_knows_is_averaged_over_steps():
    steps = {
        keys.BASE_SEEN: torch.tensor([0, 0, 10, 30]),
        keys.BURNT: torch.tensor([20, 40, 40, 40]),
    }
    assert metrics.base_coverage(steps).item() == 75
    # 0, 0, 25 and 75 %: coming home at the last moment counts for a quarter of the time
    assert metrics.base_coverage_auc(steps).item() == 25


@pytest.mark.parametrize(
    ("seen", "burning", "time"),
    [
        ([0, 3, 4, 4], [4, 4, 4, 4], 3),
        ([0, 1, 2, 3], [4, 4, 4, 4], 4),  # never: the horizon
        ([0, 4, 4, 4], [4, 4, 5, 6], 2),  # the fire has grown since
        ([3, 4, 5, 6], [4, 5, 6, 7], 4),  # always one step behind
        ([0, 0, 0, 0], [0, 0, 0, 0], 1),  # no fire
    ],
)
def test_coverage_time(seen, burning, time):
    steps = {keys.SEEN: torch.tensor(seen), keys.BURNT: torch.tensor(burning)}
    assert metrics.time_to_full_coverage(steps).item() == time


def test_coverage_without_fire_is_complete():
    steps = dict.fromkeys((keys.SEEN, keys.BURNT), torch.zeros(3, dtype=torch.int64))
    assert metrics.coverage(steps).item() == 100
    assert metrics.coverage_auc(steps).item() == 100


def by_hand(steps) -> dict[str, float]:
    """Computes the measures of one episode [T] with loops."""
    horizon, uavs = steps[keys.NEW_FIRE].shape
    on = [
        [steps[keys.NEW_FIRE][t, n] + steps[keys.OLD_FIRE][t, n] > 0 for n in range(uavs)]
        for t in range(horizon)
    ]
    first_steps = [next((t + 1 for t in range(horizon) if on[t][n]), horizon) for n in range(uavs)]
    share = [
        100 * int(s) / int(b) for s, b in zip(steps[keys.SEEN], steps[keys.BURNING], strict=True)
    ]
    left = sum(any(steps[keys.HIT_BOUNDARY][t, n]) for t in range(horizon) for n in range(uavs))
    lost = sum(bool(on[t - 1][n] and not on[t][n]) for t in range(1, horizon) for n in range(uavs))
    return {
        "mean_reward": sum(steps[keys.REWARD].flatten().tolist()) / horizon / uavs,
        "coverage": share[-1],
        "coverage_auc": sum(share) / horizon,
        "time_to_full_coverage": next((t + 1 for t, s in enumerate(share) if s == 100), horizon),
        "tracking_first": min(first_steps),
        "tracking_last": max(first_steps),
        "boundary_exits": left / uavs,
        "fire_losses": lost / uavs,
    }


@pytest.mark.parametrize("method", [None, "consensus"])
def test_episode_metrics_equal_loops(method):
    torch.manual_seed(0)  # of the random actions
    settings = {"grid": (10, 10), "num_uavs": 4, "horizon": 60}
    fire = torch.full((2, 10, 10), torch.inf)
    fire[0, 4:6, 4:6] = 0  # soon seen completely
    fire[1] = torch.rand(10, 10) * 90 - 30  # a third from the start, then one cell per step
    if method:
        env = make_env(method, num_envs=2, fire=fire, num_uavs=4, horizon=60, seed=0)
    else:
        env = WildfireEnv(2, WildfireConfig(**settings), fire, seed=0)
    steps = env.rollout(60)["next"]
    assert steps.batch_size == (2, 60)
    measured = metrics.episode_metrics(steps)
    assert tuple(measured) == metrics.NAMES
    for e in range(2):
        expected = by_hand(steps[e])
        assert {k: v[e].item() for k, v in measured.items()} == pytest.approx(expected, rel=1e-5)
    assert measured["time_to_full_coverage"][0] < 60, "time_to_full_coverage is to fire"
    assert measured["time_to_full_coverage"][1] == 60


def test_bytes_per_step_by_hand():
    assert metrics.bytes_per_step(
        {keys.BYTES_SENT: torch.tensor([[[16, 0], [32, 16]]])}
    ).tolist() == [16]
