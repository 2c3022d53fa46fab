"""Compares runs over training seeds: rankings with intervals, the paper's claims, a report."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from emberlink.trainers.comparison.report import Comparison, compare_runs, write_report

__all__ = ["Comparison", "compare_runs", "write_report"]


def __getattr__(name: str) -> Any:
    if name in __all__:
        from emberlink.trainers.comparison import report

        return getattr(report, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
