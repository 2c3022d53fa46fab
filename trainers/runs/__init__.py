"""Run folders on disk: configuration, metrics, checkpoints, lock, trackers and trained policies."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from emberlink.trainers.runs.lock import Lock
    from emberlink.trainers.runs.pretrained import open_run
    from emberlink.trainers.runs.run_folder import RunFolder

__all__ = ["Lock", "RunFolder", "open_run"]


def __getattr__(name: str) -> Any:
    """Imports a public name when it is first used; the command line starts without torch."""
    from importlib import import_module

    modules = {"Lock": "lock", "RunFolder": "run_folder", "open_run": "pretrained"}
    if name not in modules:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{modules[name]}", __name__), name)
