"""Measures the memory of a million transitions and its growth in a long run."""

import ctypes
import gc
import resource
from pathlib import Path

import pytest
from tensordict import TensorDict
from workloads import METHODS, make

from emberlink.envs import keys
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.learners.base import LearnerContext
from emberlink.trainers.learners.nan_guard import NonFiniteGuard
from emberlink.trainers.learners.off_policy.replay_buffer import ReplayMemory, to_rows
from emberlink.trainers.training.trainer import Trainer

MILLION = 1_000_000


def resident() -> int:
    """Returns the resident memory of this process in bytes."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize()


@pytest.mark.parametrize("method", METHODS)
def test_a_million_transitions(tell, method):
    """Compares resident bytes with the bytes of both observations, action and reward."""
    env = make(method, 1)
    shared = resolve(method).replay == "shared"
    rows = to_rows(env.rollout(1), 1, keys.observation_keys(env.observation_spec))
    uavs, features = rows["observation"].shape[-2:]
    # Private buffers have a million transitions each, a shared buffer a million in total.
    numbers = 4 * (2 * features + 3 + 1) * MILLION * (1 if shared else uavs)
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)  # do not reuse memory that earlier benchmarks freed
    before = resident()
    context = LearnerContext(
        observation_spec=env.observation_spec,
        action_spec=env.full_action_spec,
        num_uavs=uavs,
        num_envs=1,
        seeds=(0,),
        shared_replay=shared,
        total_steps=10**9,
        guard=NonFiniteGuard("cpu"),
        device="cpu",
    )
    memory = ReplayMemory(context, batch_size=512, buffer_size=MILLION)
    memory.extend_rows(rows)
    used = resident() - before
    tell(
        f"{method:13}: {used / 1e6:6.1f} MB for {numbers / 1e6:6.1f} MB of numbers = "
        f"{used / numbers:.3f} x (goal: at most 1.2 x)"
    )
    assert isinstance(memory.sample(), TensorDict)


def test_a_long_run_does_not_grow(tell, tmp_path):
    """Trains 100 episodes of 1000 steps with small networks and a replay buffer of 10^6."""
    small = ["learner.hidden=[16,16]", "learner.batch_size=32", "evaluation.interval=0"]
    trainer = Trainer(resolve("consensus", ["episodes=101", *small, f"output={tmp_path}"]))
    trainer.start()
    seen = []

    def watch(progress) -> None:
        if progress.step % 1000 == 0:
            seen.append(resident())

    trainer.train(watch)
    growth = (seen[-1] - seen[0]) / 1e6
    tell(
        f"resident memory over 100,000 steps: {seen[0] / 1e6:.0f} -> {seen[-1] / 1e6:.0f} MB, "
        f"{growth:+.1f} MB, at most {max(seen) / 1e6:.0f} (goal: growth below 50)"
    )
