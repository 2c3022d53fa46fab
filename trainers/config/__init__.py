"""Defines the schema of a run's configuration and composes it from YAML files and overrides."""
