"""Trains policies: set-up, training loop, checkpoints, checks for NaN and Inf, resuming.

The files in the order of a run are `command` (emberlink train), `setup` (environments, learner,
collector), `episode` (measures of the current episode), `folders` (run folders), `trainer` (the
loop), `checkpoints`, `non_finite` and `rollback` (NaN and Inf), and `resume`.
"""

from emberlink.trainers.training.non_finite import NonFiniteError, NonFiniteReport, replay
from emberlink.trainers.training.resume import resume
from emberlink.trainers.training.setup import TrainingSetup
from emberlink.trainers.training.trainer import Progress, Trainer

__all__ = [
    "NonFiniteError",
    "NonFiniteReport",
    "Progress",
    "Trainer",
    "TrainingSetup",
    "replay",
    "resume",
]
