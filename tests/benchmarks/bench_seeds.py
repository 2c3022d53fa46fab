"""Compares the time of several seeds in a stack with that of sequential trainings."""

import pytest
import torch
from workloads import in_turns

from emberlink.trainers.config.compose import resolve
from emberlink.trainers.training.setup import TrainingSetup

STEPS = 20


def learning(overrides: list[str]):
    """Returns a function that runs training steps with a filled replay buffer."""
    setup = TrainingSetup(resolve("consensus", ["episodes=1000", *overrides]))
    collected = iter(setup.collector)
    while setup.step < setup.learner.learning_starts + 5:
        setup.learn(next(collected))

    def learn() -> None:
        for _ in range(STEPS):
            setup.learn(next(collected))
        if setup.config.device == "cuda":
            torch.cuda.synchronize()

    return learn


@pytest.mark.parametrize("device", ["cpu", "cuda"])
@pytest.mark.parametrize("setup", ["paper", "tuned"])
def test_five_seeds(tell, setup, device):
    if device == "cuda" and not torch.cuda.is_available():
        pytest.skip("no GPU")
    common = [f"setup={setup}", f"device={device}"]
    single, five = in_turns(
        5, learning([*common, "seed=0"]), learning([*common, "seeds=[0,1,2,3,4]"])
    )
    goal = "at most 5" if device == "cpu" else "nearly 1"
    tell(
        f"5 seeds, {setup}, {device}: {1000 * five / STEPS:.1f} ms a step, one alone "
        f"{1000 * single / STEPS:.1f} ms: {five / single:.2f} x (goal: {goal})"
    )
