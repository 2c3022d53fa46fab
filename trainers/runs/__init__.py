"""Manages run folders: configuration, metrics, checkpoints, lock, trained policies."""

from typing import TYPE_CHECKING

from emberlink.envs.utils.lazy import lazy

if TYPE_CHECKING:
    from emberlink.trainers.runs.lock import Lock
    from emberlink.trainers.runs.pretrained import open_run
    from emberlink.trainers.runs.run_folder import RunFolder

__all__ = ["Lock", "RunFolder", "open_run"]

__getattr__ = lazy(__name__, {"Lock": "lock", "RunFolder": "run_folder", "open_run": "pretrained"})
