"""Trains and evaluates many runs: every combination of methods, seeds and settings."""
