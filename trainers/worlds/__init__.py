"""Calibrates worlds: tests that a world is worth learning in, and compares many worlds."""
