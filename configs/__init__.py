"""The YAML files of configurations, and the search for those of other packages and folders."""

from emberlink.configs.search import ENTRY_POINTS, VARIABLE, find, folders, known, read

__all__ = ["ENTRY_POINTS", "VARIABLE", "find", "folders", "known", "read"]
