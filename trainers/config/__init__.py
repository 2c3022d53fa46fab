"""The settings of a run: their schema, and their composition from YAML files and overrides."""

from emberlink.trainers.config.schema import RunConfig

from .compose import flat, from_values, override, resolve, to_values

__all__ = ["RunConfig", "flat", "from_values", "override", "resolve", "to_values"]
