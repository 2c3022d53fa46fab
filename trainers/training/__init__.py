"""Trains policies: what is trained, the loop, checkpoints, checks for NaN, and resuming.

The files in the order of a run: `command` (emberlink train), `setup` (environments, learner,
collector), `episode` (measures of the episode at hand), `folders` (run folders), `trainer` (the
loop), `checkpoints`, `non_finite` and `rollback` (NaN and Inf), `resume`.
"""

from .non_finite import NonFiniteError, NonFiniteReport, replay
from .resume import resume
from .setup import TrainingSetup
from .trainer import Progress, Trainer

__all__ = [
    "NonFiniteError",
    "NonFiniteReport",
    "Progress",
    "Trainer",
    "TrainingSetup",
    "replay",
    "resume",
]
