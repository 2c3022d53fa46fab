"""The settings of a run: their schema, and their composition from YAML files and overrides."""

from emberlink.trainers.config.compose import flat, from_values, override, resolve, to_values
from emberlink.trainers.config.schema import RunConfig

__all__ = ["RunConfig", "flat", "from_values", "override", "resolve", "to_values"]
