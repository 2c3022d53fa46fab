"""Compares GPU and CPU results, and times the paper's protocol."""

import time

import pytest
import torch
from workloads import METHODS

from emberlink.envs import keys
from emberlink.trainers import make_env
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.training.trainer import Trainer

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")


@pytest.mark.parametrize("setup", ["paper", "released", "tuned"])
@pytest.mark.parametrize("method", METHODS)
def test_the_environment_is_the_same(method, setup):
    """Compares 200 steps with the same actions, including the end of an episode."""
    envs = [
        make_env(method, setup, num_envs=3, horizon=150, seed=0, device=d) for d in ("cpu", "cuda")
    ]
    tds = [env.reset() for env in envs]
    for step in range(200):
        action = 2 * torch.rand(3, 6, 3, generator=torch.Generator().manual_seed(step)) - 1
        following = []
        for at, env in enumerate(envs):
            tds[at].set(keys.ACTION, action.to(env.device))
            done, tds[at] = env.step_and_maybe_reset(tds[at])
            following.append(done["next"].cpu())
        for name, value in following[0].items(include_nested=True, leaves_only=True):
            torch.testing.assert_close(following[1][name], value, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("method", METHODS)
def test_a_recipe_learns_the_same(method, tmp_path):
    """Compares 60 updates, with the CPU's."""
    small = ["env.horizon=40", "episodes=2", "num_envs=2", "learner.batch_size=32"]
    weights = []
    for device in ("cpu", "cuda"):
        trainer = Trainer(
            resolve(method, [*small, "seed=1", f"device={device}", f"output={tmp_path / device}"])
        )
        trainer.start()
        trainer.train()
        weights.append(trainer.setup.learner.weights())
    cpu, gpu = weights
    for name, value in cpu.items():
        torch.testing.assert_close(gpu[name].cpu(), value, rtol=1e-2, atol=1e-3)


def seconds_of(method: str, output, *overrides: str) -> float:
    """Returns the duration of the whole protocol, extrapolated from a run of 10 episodes."""
    config = resolve(
        method,
        ["device=cuda", "episodes=10", "evaluation.interval=0", f"output={output}", *overrides],
    )
    trainer = Trainer(config)
    trainer.start()
    marks = {}

    def watch(progress) -> None:
        if progress.step % 1000 == 0:
            torch.cuda.synchronize()
            marks[progress.episode] = time.perf_counter()

    trainer.train(watch)
    return 200 * (marks[10] - marks[2]) / 8


def test_one_method_one_seed(tell, tmp_path):
    seconds = seconds_of("consensus", tmp_path)
    tell(f"200 episodes, 200,000 updates, consensus: {seconds:.0f} s (goal: at most 180)")
