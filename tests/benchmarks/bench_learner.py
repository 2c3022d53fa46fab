"""Measures a training: its updates, everything else, and what single settings save."""

import time
from functools import partial
from typing import Any

import pytest
from workloads import METHODS, in_turns

from emberlink.trainers.config.compose import resolve
from emberlink.trainers.training.setup import TrainingSetup


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("setup", ["tuned", "strong"])
def test_parts_of_a_training(tell, method, setup):
    """Trains two episodes of 200 steps and reports the second."""
    training = TrainingSetup(resolve(method, [f"setup={setup}", "env.horizon=200", "episodes=2"]))
    learner: Any = training.learner
    learn, inside = learner.learn, 0.0

    def timed(rollout):
        nonlocal inside
        began = time.process_time()
        losses = learn(rollout)
        inside += time.process_time() - began
        return losses

    learner.learn = timed
    training.dry_run(training.horizon)
    began, inside = time.process_time(), 0.0
    training.dry_run(training.horizon)
    whole = time.process_time() - began
    decisions = training.horizon // training.config.policy.hold * training.config.num_envs
    tell(
        f"{setup}, {method:13}: {decisions / whole:7,.0f} team decisions a CPU second, "
        f"{100 * inside / whole:3.0f} % of the time in the learner"
    )


@pytest.mark.parametrize(
    ("method", "world", "plain", "fast"),
    [
        ("independent", "paper", "chunk=0", "chunk=25"),
        ("maps", "front", "critic_map=false", "critic_map=true"),
        ("maps", "front", "bfloat16=false", "bfloat16=true"),
    ],
)
def test_a_setting_against_the_plain_way(tell, method, world, plain, fast):
    """Trains episodes of 500 steps with both, in turns."""
    common, works = ["setup=strong", f"world={world}", "env.horizon=500", "episodes=9"], []
    for setting in (plain, fast):
        training = TrainingSetup(resolve(method, [*common, f"learner.{setting}"]))
        works.append(partial(training.dry_run, training.horizon))
    slow, quick = in_turns(2, *works)
    tell(f"strong, {method:13}: an iteration with {fast} takes {quick / slow:.2f} of {plain}")
