"""Begins a run with the actors of another run (`learner.warm_start`)."""

import warnings

from emberlink.comm.base import MODULES
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import shown
from emberlink.trainers.config.compose import differences
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.evaluation.policy import units
from emberlink.trainers.learners.base import Learner
from emberlink.trainers.runs.checkpoint import load_weights
from emberlink.trainers.runs.pretrained import read_run

_OBSERVED = ("comm.", "env.observation", "env.map.", "policy.hold")
"""prefixes of keys that define the meaning of observations and actions, besides `units`"""


def start(learner: Learner, config: RunConfig) -> None:
    """Copies the actors of the run `learner.warm_start`, of its newest checkpoint, to a learner."""
    name = getattr(config.learner, "warm_start", "")
    if not name:
        return
    try:
        run = read_run(name)
        theirs = run.config()
        weights = load_weights(run.newest, learner.actor.module, config)
    except UserError as error:
        said = str(error).removeprefix(f"{name}: ")
        raise UserError(f"learner.warm_start={name}: {said}") from None
    _warn_of_other_observations(name, theirs, config)
    learner.start_from(weights)


def _warn_of_other_observations(name: str, theirs: RunConfig, mine: RunConfig) -> None:
    """Warns of settings that give the same observations another meaning."""
    more = ("env.base",) if mine.env.observation == "map" else ()  # maps show the base
    more += ("env.radio.",) if MODULES.find(mine.comm["name"]).hears else ()
    for key, (before, now) in differences(theirs, mine).items():
        of_reward = key.startswith("comm.heading.")
        if key.startswith((*_OBSERVED, *units(mine), *more)) and not of_reward:
            warnings.warn(
                f"learner.warm_start={name}: its actors were trained with {key}={shown(before)}, "
                f"this run has {shown(now)}",
                stacklevel=3,
            )
