"""Begins a run with the actors of another run (`learner.warm_start`)."""

import warnings
from typing import Any

from emberlink.comm.base import MODULES
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import shown
from emberlink.trainers.config.compose import to_values
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.config.values import flat
from emberlink.trainers.evaluation.policy import units
from emberlink.trainers.learners.base import ACTOR, Learner
from emberlink.trainers.runs.checkpoint import load_weights
from emberlink.trainers.runs.pretrained import find_one, is_name
from emberlink.trainers.runs.run_folder import RunFolder

_OBSERVED = ("comm.", "env.observation", "policy.hold")
"""prefixes of keys that define the meaning of observations and actions, besides `units`"""

_REWARD = "comm.heading."
"""prefix of the keys of `comm` that change rewards only"""


def start(learner: Learner, config: RunConfig) -> None:
    """Copies the actors of the run `learner.warm_start`, of its newest checkpoint, to a learner.

    Raises:
        UserError: the run or its checkpoint cannot be read, or does not fit.
    """
    name = getattr(config.learner, "warm_start", "")
    if not name:
        return
    network: Any = learner.actor.module
    expected = {ACTOR + key: value for key, value in network.state_dict().items()}
    try:
        run = RunFolder(find_one(name) if is_name(name) else name)
        # The device of that run may not exist here.
        theirs = run.config(device=config.device)
        weights = load_weights(run.checkpoint(), expected, config)
    except UserError as error:
        said = str(error).removeprefix(f"{name}: ")
        raise UserError(f"learner.warm_start={name}: {said}") from None
    _warn_of_other_observations(name, theirs, config)
    learner.start_from(weights)


def _warn_of_other_observations(name: str, theirs: RunConfig, mine: RunConfig) -> None:
    """Warns of settings that give the same observations another meaning."""
    before, now = flat(to_values(theirs)), flat(to_values(mine))
    more = units(mine)
    more += ("env.base",) if mine.env.observation == "sight" else ()  # maps show the base
    more += ("env.radio.",) if MODULES.find(mine.comm["name"]).hears else ()
    observed = (key for key in now if key.startswith(_OBSERVED + more) and key in before)
    for key in observed:
        if before[key] != now[key] and not key.startswith(_REWARD):
            warnings.warn(
                f"learner.warm_start={name}: its actors were trained with {key}="
                f"{shown(before[key])}, this run has {shown(now[key])}",
                stacklevel=3,
            )
