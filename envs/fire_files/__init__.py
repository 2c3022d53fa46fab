"""Fires from files: reads rasters, perimeters, the paper's text and banks onto a grid."""

from .banks import write_bank
from .config import FileFireConfig
from .reader import FireSets, fire_sets, read_fires, save_copy, with_checksum

__all__ = [
    "FileFireConfig",
    "FireSets",
    "fire_sets",
    "read_fires",
    "save_copy",
    "with_checksum",
    "write_bank",
]
