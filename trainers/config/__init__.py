"""The settings of a run: their schema, and their composition from YAML files and overrides."""

from .compose import flat, from_values, override, resolve, to_values
from .schema import RunConfig

__all__ = ["RunConfig", "flat", "from_values", "override", "resolve", "to_values"]
