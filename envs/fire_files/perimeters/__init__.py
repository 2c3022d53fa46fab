"""Perimeters over time: the layers of vector files, their areas and their times."""

from emberlink.envs.fire_files.perimeters.reader import read_perimeters

__all__ = ["read_perimeters"]
