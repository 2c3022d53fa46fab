"""Measures what a training spends on updates and on everything else, in CPU seconds of one run."""

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


def test_chunks_against_whole_episodes(tell):
    """Updates of `strong` from the same episodes, in turns."""
    rollouts: list[Any] = []
    learners: list[Any] = []
    for chunk in (0, 25):
        training = TrainingSetup(resolve("independent", ["setup=strong", f"learner.chunk={chunk}"]))
        learner: Any = training.learner
        learners.append(learner)
        if not rollouts:
            learn = learner.learn
            learner.learn = lambda rollout: rollouts.append(rollout.clone()) or []
            training.dry_run(training.horizon)
            learner.learn = learn

    def update(learner: Any) -> None:
        learner.decisions = 0
        for rollout in rollouts:
            learner.learn(rollout)

    whole, chunks = in_turns(3, *(partial(update, learner) for learner in learners))
    tell(
        f"update of independent from chunks of 25 decisions: {whole / chunks:.2f} x whole episodes"
    )
