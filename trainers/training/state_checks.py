"""Whether the world of a state is one that can have come about."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from emberlink.envs.utils.errors import UserError

if TYPE_CHECKING:
    from .trainer import Trainer

ARRIVAL = "_map._arrival_time"
"""the fire of each environment: infinite where it never burns, NaN in the margin"""
_OF_EPISODE = ("_seed_key", "_episode", "_episode_key", "_step_key", "_map._burning_start")
"""what is a function of the seeds and of the number of the episode"""
_OF_MOMENT = {"step": "_time", "seen": "_seen", "rng_key": "_step_key"}
"""what the carried moment repeats of the world"""


def begin_episode(trainer: "Trainer") -> dict[str, Tensor]:
    """Puts a training's world where its episode begins: its tensors, as they lie in memory."""
    env = trainer.env.base_env
    world = env.state_dict()
    world["_episode"].fill_(trainer.episode)
    env.reset()
    return world


def check(path: Path, found: Mapping[str, Tensor], trainer: "Trainer") -> None:
    """That a world is one of a training's step.

    Args:
        path: of the checkpoint, for messages.
        found: the world's tensors, of the right names, shapes and types.
        trainer: whose world is where this episode begins.

    Raises:
        ValueError: it is not; the message names the tensor.
    """
    begun = {name: value.cpu() for name, value in trainer.env.base_env.state_dict().items()}
    config, uavs = trainer.config.env, trainer.config.env.num_uavs
    time = trainer.step % config.horizon
    stamps = begun["_map._stamp"] + time * uavs
    first, never = found["_map._first_seen"], begun["_map._first_seen"]
    seen = first != never
    possible = (first >= uavs) & (first <= stamps.amax())
    low, high = torch.tensor(config.low).double(), torch.tensor(config.high).double()
    right = {
        **{name: found[name].equal(begun[name]) for name in _OF_EPISODE},
        "_time": bool((found["_time"] == time).all()),
        "_map._stamp": found["_map._stamp"].equal(stamps),
        # Another machine computes the same fire to a few digits.
        ARRIVAL: torch.allclose(found[ARRIVAL], begun[ARRIVAL], 1e-3, 1e-3, equal_nan=True),
        "_map._first_seen": bool((possible | ~seen).all()),
        "_seen": found["_seen"].equal(seen.sum(-1)),
        "_position": bool(
            ((found["_position"] >= low - 1e-3) & (found["_position"] <= high + 1e-3)).all()
        ),
    }
    for name, fits in right.items():
        if not fits:
            raise UserError(f"{path}: world/{name} is not one of step {trainer.step}")


def check_carried(path: Path, carried: Mapping[str, Tensor], world: Mapping[str, Tensor]) -> None:
    """That the moment which the next step begins with is the world's.

    Raises:
        ValueError: it is not; the message names the tensor.
    """
    for name, of in _OF_MOMENT.items():
        if not carried[name].equal(world[of]):
            raise UserError(f"{path}: carried/{name} is not world/{of}")
