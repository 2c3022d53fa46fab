"""Fires from files: reads rasters, perimeters, the paper's text and banks onto a grid."""

from emberlink.envs.fire_files.config import FileFireConfig
from emberlink.envs.fire_files.reader import (
    FireSets,
    fire_sets,
    read_fires,
    save_copy,
    with_checksum,
)

__all__ = [
    "FileFireConfig",
    "FireSets",
    "fire_sets",
    "read_fires",
    "save_copy",
    "with_checksum",
]
