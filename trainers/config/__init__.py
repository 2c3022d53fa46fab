"""Defines the schema of a run's configuration and composes it from YAML files and overrides."""

from emberlink.trainers.config.compose import flat, from_values, override, resolve, to_values
from emberlink.trainers.config.schema import RunConfig

__all__ = ["RunConfig", "flat", "from_values", "override", "resolve", "to_values"]
