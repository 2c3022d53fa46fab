"""Learners: how the UAVs' networks are trained from the transitions that are collected."""

from emberlink.trainers.learners.base import Learner, LearnerConfig, LearnerContext, Losses
from emberlink.trainers.learners.registry import build, find, known

__all__ = ["Learner", "LearnerConfig", "LearnerContext", "Losses", "build", "find", "known"]
