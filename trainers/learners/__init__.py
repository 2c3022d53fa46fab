"""Learning algorithms: they train the networks of all UAVs from collected transitions."""

from emberlink.trainers.learners.base import Learner, LearnerConfig, LearnerContext, Losses
from emberlink.trainers.learners.registry import build, find, known

__all__ = ["Learner", "LearnerConfig", "LearnerContext", "Losses", "build", "find", "known"]
