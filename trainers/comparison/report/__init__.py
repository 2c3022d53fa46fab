"""Writes the report of a comparison: compare.html, compare.json and the figures."""

from emberlink.trainers.comparison.report.write import free_folder, write_report

__all__ = ["free_folder", "write_report"]
