"""Begins a run with the actors of another run (`learner.warm_start`)."""

from typing import Any

from emberlink.envs.utils.errors import UserError
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.learners.base import ACTOR, Learner
from emberlink.trainers.runs.checkpoints import load_weights
from emberlink.trainers.runs.pretrained import open_run
from emberlink.trainers.runs.seal import check_trained_with


def start(learner: Learner, config: RunConfig) -> None:
    """Copies the actors of the run `learner.warm_start` to all seeds of a learner.

    Their checkpoint is the newest of the run. Its checksum, the configuration that it was trained
    with, and the names, shapes and values of its weights are checked.

    Args:
        learner: a new learner.
        config: its configuration.

    Raises:
        UserError: the run or its checkpoint cannot be read, or does not fit.
    """
    name = getattr(config.learner, "warm_start", "")
    if not name:
        return
    run = open_run(name, config.output)
    checkpoint = run.checkpoint()
    check_trained_with(checkpoint, run.config())
    network: Any = learner.actor.module
    teams = len(config.seeds or (config.seed,))
    expected = {
        ACTOR + key: value.unflatten(0, (teams, -1))[0]
        for key, value in network.state_dict().items()
    }
    try:
        weights = load_weights(checkpoint, expected, config)
    except UserError as error:
        raise UserError(f"learner.warm_start={name}: {error}") from None
    learner.start_from(weights)
