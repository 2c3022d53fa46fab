"""Configuration files in YAML, and the search for those of other packages and folders."""

from emberlink.configs.search import ENTRY_POINTS, VARIABLE, folders, known

__all__ = ["ENTRY_POINTS", "VARIABLE", "folders", "known"]
