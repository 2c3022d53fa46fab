"""Fires from files: reads rasters, perimeters, the paper's text and banks onto a grid."""

from typing import TYPE_CHECKING

from emberlink.envs.utils.lazy import lazy

if TYPE_CHECKING:
    from emberlink.envs.fire_files.reader import fire_sets, save_copy, with_checksum

__all__ = ["fire_sets", "save_copy", "with_checksum"]

# The readers import scipy, which takes a third of a second.
__getattr__ = lazy(__name__, {"reader": "fire_sets save_copy with_checksum"})
