"""Compares runs over training seeds: rankings with intervals, the paper's claims, a report."""

from typing import TYPE_CHECKING

from emberlink.envs.utils.lazy import lazy

if TYPE_CHECKING:
    from emberlink.trainers.comparison.report import write_report
    from emberlink.trainers.comparison.results import Comparison, compare_runs

__all__ = ["Comparison", "compare_runs", "write_report"]

__getattr__ = lazy(
    __name__, {"Comparison": "results", "compare_runs": "results", "write_report": "report"}
)
