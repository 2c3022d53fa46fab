"""Writes the page that plays episodes: one file of HTML without external files."""

import base64
import gzip
import html
import json
import math
import re
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, StrictUndefined
from numpy.typing import NDArray

from emberlink.envs.utils.atomic_io import user_path
from emberlink.envs.world.sensor import Sensor
from emberlink.trainers.replay.recording import AGES, COUNTS, OF_BASE, ROLES, Episode

SCRIPTS = ("unpack.js", "knowledge.js", "palette.js", "map.js", "curves.js", "replay.js")
"""modules of the page, each after the modules that it imports"""
_IMPORT = re.compile(r"^import .*?;\n", re.MULTILINE | re.DOTALL)
_EXPORT = re.compile(r"^export (?=const|function|class|async)", re.MULTILINE)
_VERSION = 1  # of the data, see web/unpack.js
_HUNDREDTHS = 100  # units of a stored position per cell
_ALIGNED = 8


class Replay:
    """A page that plays episodes on the fire `fire` side by side; Jupyter shows it inline."""

    def __init__(self, shown: Sequence[Episode], fire: str):
        environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True)
        self.html = environment.from_string(_read("web", "page.html")).render(
            fire=fire,
            style=_read("web", "page.css"),
            uplot_style=_read("uplot", "uPlot.min.css"),
            uplot=_read("uplot", "uPlot.iife.min.js"),
            uplot_licence=_read("uplot", "LICENSE"),
            script=script(),
            data=base64.b64encode(encode(shown, fire)).decode(),
        )
        """the whole page"""

    def save(self, path: Path | str) -> None:
        """Writes the page to a file."""
        user_path(path).write_text(self.html, encoding="utf-8")

    def __repr__(self) -> str:
        return f"<Replay, {len(self.html) // 1000} kB of HTML>"

    def _repr_html_(self) -> str:
        """Returns the page in a frame, for Jupyter."""
        return (
            f'<iframe srcdoc="{html.escape(self.html)}" title="Replay" sandbox="allow-scripts" '
            'style="width:100%;height:820px;border:0"></iframe>'
        )


@cache
def script() -> str:
    """Returns the modules of the page as one: their imports of each other are left out."""
    parts = (_IMPORT.sub("", _read("web", name)) for name in SCRIPTS)
    return "\n".join(_EXPORT.sub("", part) for part in parts)


@cache
def _read(*names: str) -> str:
    return files("emberlink.trainers.replay").joinpath(*names).read_text("utf-8")


def encode(shown: Sequence[Episode], fire: str) -> bytes:
    """Returns the data of a page, which web/unpack.js reads.

    They are compressed with gzip, whose checksum finds damage, and begin with the length of a
    header in JSON. The header describes the episodes and lists the arrays, which follow.
    """
    first = shown[0].recording
    arrays = _Arrays()
    header = {
        "version": _VERSION,
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


def _panel(shown: Episode, arrays: "_Arrays") -> dict[str, Any]:
    """Adds the arrays of an episode and returns its part of the header."""
    world, steps = shown.recording.world, shown.recording.steps
    tracks = _by_time(_hundredths(steps["position"]))
    panel: dict[str, Any] = {
        "title": shown.title,
        "uavs": world.num_uavs,
        "base": None if world.base is None else list(world.base),
        "side": Sensor.of(world).side,
        "slope": math.tan(math.radians(world.view_angle)),
        "fails": [int(step) for step in steps["alive"].sum(0)],
        "position": arrays.add(tracks, delta=True),
        "view": arrays.add(_by_time(steps["view"].astype(np.uint8)), delta=True),
        "hears": arrays.add(_bits(steps["hears"])),
        "reward": arrays.add(_by_time(steps["reward"])),
    }
    if steps["lost"].any():
        panel["lost"] = arrays.add(_bits(steps["lost"]))
    if "missed" in steps:
        panel["missed"] = arrays.add(_bits(steps["missed"]))
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
    units = np.rint(np.nan_to_num(cells.astype(np.float64)) * _HUNDREDTHS)
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
        """Adds an array of integers or float32 and returns its place, type and shape.

        With `delta` the differences along the last axis are stored, which compress better.
        """
        stored = array
        if delta:  # differences of integers wrap round, and so do the sums in the browser
            stored = np.diff(array, axis=-1, prepend=array.dtype.type(0))
        stored = np.ascontiguousarray(stored, dtype=array.dtype.newbyteorder("<"))
        entry = {"type": array.dtype.str[1:], "shape": array.shape, "at": len(self.content)}
        self.content += stored.tobytes()
        self.content += bytes(-len(self.content) % _ALIGNED)
        return {**entry, "delta": delta}
