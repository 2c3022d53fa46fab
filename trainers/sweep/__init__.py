"""Trains and evaluates many runs: every combination of methods, seeds and settings."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from emberlink.trainers.sweep.command import sweep
    from emberlink.trainers.sweep.jobs import Job, jobs_of

__all__ = ["Job", "jobs_of", "sweep"]


def __getattr__(name: str) -> Any:
    # The process of a run imports this package too, and needs none of it.
    if name == "sweep":
        from emberlink.trainers.sweep.command import sweep

        return sweep
    if name in __all__:
        from emberlink.trainers.sweep import jobs

        return getattr(jobs, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
