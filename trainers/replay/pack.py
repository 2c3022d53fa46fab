"""Packs recordings into a few bytes for the page; web/unpack.js reads them.

The bytes are compressed with gzip, whose checksum finds damage. They begin with the length of a
header in JSON. The header describes the episodes and lists the arrays, which follow.
"""

import gzip
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emberlink.envs.rendering.marks import ROLES
from emberlink.trainers.replay.record import AGES, COUNTS, OF_BASE, Recording

VERSION = 1
"""version of the format"""
HUNDREDTHS = 100
"""units of a packed position per cell"""
_ALIGNED = 8


@dataclass(frozen=True, kw_only=True)
class Shown:
    """An episode of the page and its title."""

    title: str
    recording: Recording


def pack(shown: Sequence[Shown], fire: str) -> bytes:
    """Returns the data of a page.

    Args:
        shown: episodes on the same fire.
        fire: name of the fire.
    """
    first = shown[0].recording
    arrays = _Arrays()
    header = {
        "version": VERSION,
        "fire": fire,
        "grid": list(first.world.grid),
        "horizon": first.horizon,
        "roles": ROLES,
        "ignition": arrays.add(_steps(first.ignition, first.horizon).ravel()),
        "end": arrays.add(_steps(first.end, first.horizon).ravel()),
        "panels": [_panel(one, arrays) for one in shown],
    }
    text = json.dumps(header, allow_nan=False, separators=(",", ":")).encode()
    text += b" " * (-(len(text) + 4) % _ALIGNED)
    # Without a time stamp, so that the same episode gives the same bytes.
    return gzip.compress(len(text).to_bytes(4, "little") + text + arrays.content, 9, mtime=0)


def _panel(shown: Shown, arrays: "_Arrays") -> dict[str, Any]:
    """Adds the arrays of an episode and returns its part of the header."""
    world, steps = shown.recording.world, shown.recording.steps
    tracks = _by_time(_hundredths(steps["position"]))
    panel: dict[str, Any] = {
        "title": shown.title,
        "uavs": world.num_uavs,
        "base": None if world.base is None else list(world.base),
        "slope": math.tan(math.radians(world.view_angle)),
        "fails": [int(step) for step in steps["alive"].sum(0)],
        "position": arrays.add(tracks, delta=True),
        "view": arrays.add(_by_time(steps["view"].astype(np.uint8)), delta=True),
        "hears": arrays.add(_bits(steps["hears"])),
        "reward": arrays.add(_by_time(steps["reward"])),
    }
    if steps["lost"].any():
        panel["lost"] = arrays.add(_bits(steps["lost"]))
    if "follows" in steps:
        panel["follows"] = arrays.add(_by_time(steps["follows"].astype(np.int8)))
    if "target" in steps:
        panel["target"] = arrays.add(_by_time(_hundredths(steps["target"][..., :2])), delta=True)
    for name in (*COUNTS, *AGES, *OF_BASE):
        if name in steps:
            whole = name in COUNTS or name == "base_seen"
            values = steps[name].astype(np.int32 if whole else np.float32)
            panel[name] = arrays.add(values[None], delta=whole)
    return panel


def _steps(steps: NDArray[Any], horizon: int) -> NDArray[Any]:
    """Returns steps up to `horizon + 1` in the smallest type for them."""
    return steps.astype(np.uint16 if horizon < np.iinfo(np.uint16).max else np.uint32)


def _hundredths(cells: NDArray[np.float32]) -> NDArray[np.int16]:
    """Returns lengths in hundredths of a cell; a map has at most 256 cells a side."""
    units = np.rint(np.nan_to_num(cells.astype(np.float64)) * HUNDREDTHS)
    return units.clip(np.iinfo(np.int16).min, np.iinfo(np.int16).max).astype(np.int16)


def _by_time(values: NDArray[Any]) -> NDArray[Any]:
    """Changes [T + 1, ...] to [rows, T + 1]: what changes little stands side by side."""
    return np.ascontiguousarray(values.reshape(len(values), -1).T)


def _bits(links: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Packs [T + 1, r, r] as 8 steps a byte, the first in the lowest bit: [r * r, bytes]."""
    return np.packbits(_by_time(links), axis=1, bitorder="little")


class _Arrays:
    """Joins arrays to bytes; each begins at a multiple of 8."""

    def __init__(self) -> None:
        self.content = b""

    def add(self, array: NDArray[Any], *, delta: bool = False) -> Mapping[str, Any]:
        """Adds an array and returns where and what it is.

        Args:
            array: integers or float32.
            delta: whether to store the differences along the last axis, which compress better.
        """
        stored = array
        if delta:  # differences of integers wrap round, and so do the sums in the browser
            stored = np.diff(array, axis=-1, prepend=array.dtype.type(0))
        stored = np.ascontiguousarray(stored, dtype=array.dtype.newbyteorder("<"))
        entry = {"type": array.dtype.str[1:], "shape": array.shape, "at": len(self.content)}
        self.content += stored.tobytes()
        self.content += bytes(-len(self.content) % _ALIGNED)
        return {**entry, "delta": delta}
