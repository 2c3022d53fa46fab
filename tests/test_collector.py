"""The collector for GPUs yields what TorchRL's collector yields."""

import pytest
import torch

from emberlink.trainers.build import build_env
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.rollout.collector import LockstepCollector, ResumableCollector
from emberlink.trainers.training.setup import TrainingSetup

HORIZON, STEPS, ENVS = 6, 18, 3


def world(method: str):
    config = resolve(method, ["setup=tuned"], horizon=HORIZON, num_envs=ENVS, hidden=[8, 8])
    env = build_env(config, num_envs=ENVS, fire=config.fire, seed=5, device="cpu")
    return env, TrainingSetup(config).learner.explorer


@pytest.mark.parametrize("method", ["independent", "consensus"])
@pytest.mark.parametrize("rollout_steps", [1, 3])
def test_both_collectors_yield_the_same_numbers(method, rollout_steps):
    sizes = {"total_steps": STEPS, "rollout_steps": rollout_steps}
    expected = [td.clone() for td in ResumableCollector(*world(method), **sizes)]
    collector = LockstepCollector(*world(method), horizon=HORIZON, **sizes)
    yielded = [td.clone() for td in collector]
    assert len(yielded) == len(expected) == STEPS // rollout_steps
    for one, other in zip(yielded, expected, strict=True):
        assert one.shape == (ENVS, rollout_steps)
        for key in one.keys(include_nested=True, leaves_only=True):
            assert torch.equal(one[key], other[key]), key
