"""Configuration files in YAML, and the search for those of other packages and folders."""

from emberlink.configs.search import describe, folders, known

__all__ = ["describe", "folders", "known"]
