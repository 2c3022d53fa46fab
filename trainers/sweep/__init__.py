"""Trains and evaluates many runs: every combination of methods, seeds and settings."""

from typing import TYPE_CHECKING

from emberlink.envs.utils.lazy import lazy

if TYPE_CHECKING:
    from emberlink.trainers.sweep.command import sweep
    from emberlink.trainers.sweep.jobs import Job, jobs_of

__all__ = ["Job", "jobs_of", "sweep"]

__getattr__ = lazy(__name__, {"Job": "jobs", "jobs_of": "jobs", "sweep": "command"})
