"""Configuration files in YAML, and the search for those of other packages and folders."""

from emberlink.configs.search import ENTRY_POINTS, VARIABLE, describe, folders, known

__all__ = ["ENTRY_POINTS", "VARIABLE", "describe", "folders", "known"]
