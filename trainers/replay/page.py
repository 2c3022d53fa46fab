"""Writes the page that plays episodes: one file of HTML without external files."""

import base64
import gzip
import html
import json
import math
import re
from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, StrictUndefined
from numpy.typing import NDArray

from emberlink.envs.utils.atomic_io import user_path
from emberlink.envs.world.sensor import Sensor
from emberlink.trainers.replay.recording import ROLES, Recording

SCRIPTS = ("unpack.js", "knowledge.js", "palette.js", "map.js", "curves.js", "replay.js")
"""modules of the page, each after the modules that it imports"""
_IMPORT = re.compile(r"^import .*?;\n", re.MULTILINE | re.DOTALL)
_EXPORT = re.compile(r"^export (?=const|function|class|async)", re.MULTILINE)


class Replay:
    """A page that plays episodes on the fire `fire` side by side; Jupyter shows it inline."""

    def __init__(self, shown: Sequence[Recording], fire: str):
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


def encode(shown: Sequence[Recording], fire: str) -> bytes:
    """Returns the data of a page, JSON that is compressed with gzip, which web/unpack.js reads."""
    first = shown[0]
    data = {
        "fire": fire,
        "grid": list(first.world.grid),
        "horizon": first.horizon,
        "roles": ROLES,
        "ignition": first.ignition.ravel().tolist(),
        "end": first.end.ravel().tolist(),
        "panels": [_panel(one) for one in shown],
    }
    text = json.dumps(data, allow_nan=False, separators=(",", ":"))
    # Without a time stamp, so that the same episode gives the same bytes.
    return gzip.compress(text.encode(), 9, mtime=0)


def _panel(shown: Recording) -> dict[str, Any]:
    """Returns the data of an episode; `steps` has a row for each number, with all its steps."""
    world, steps = shown.world, shown.steps | {"front_age": shown.front_age()}
    fails = [int(step) for step in steps.pop("alive").sum(0)]
    if not steps["lost"].any():
        del steps["lost"]
    steps["position"] = _hundredths(steps["position"])
    if "target" in steps:
        steps["target"] = _hundredths(steps["target"][..., :2])
    return {
        "title": shown.title,
        "uavs": world.num_uavs,
        "base": None if world.base is None else list(world.base),
        "side": Sensor(world).side,
        "slope": math.tan(math.radians(world.view_angle)),
        "fails": fails,
        **({"delay": world.radio.delay} if world.radio.packets else {}),
        "steps": {name: _rows(values) for name, values in steps.items()},
    }


def _hundredths(cells: NDArray[np.float32]) -> NDArray[np.int64]:
    """Returns lengths in hundredths of a cell."""
    return np.rint(np.nan_to_num(cells.astype(np.float64)) * 100).astype(np.int64)


def _rows(values: NDArray[Any]) -> list[Any]:
    """Returns [T + 1, ...] as rows of T + 1 numbers, or texts of 0 and 1 for bool."""
    rows = values.reshape(len(values), -1).T
    if values.dtype == bool:
        return [(row + np.uint8(ord("0"))).tobytes().decode() for row in rows]
    if values.dtype == np.float32:  # as double, they would have twice as many digits
        rows = rows.astype(str).astype(float)
    return rows.tolist()
