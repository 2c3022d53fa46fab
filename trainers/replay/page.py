"""Writes the page of a replay: one file of HTML without external files."""

import base64
import html
import re
from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path

from jinja2 import Environment, StrictUndefined

from emberlink.trainers.replay.pack import Shown, pack

SCRIPTS = ("unpack.js", "knowledge.js", "palette.js", "map.js", "curves.js", "replay.js")
"""modules of the page, each after those that it imports"""
_IMPORT = re.compile(r"^import .*?;\n", re.MULTILINE | re.DOTALL)
_EXPORT = re.compile(r"^export (?=const|function|class|async)", re.MULTILINE)


class Replay:
    """A page that plays episodes on the same fire side by side; Jupyter shows it inline.

    Args:
        shown: the episodes and their titles.
        fire: name of the fire.
    """

    def __init__(self, shown: Sequence[Shown], fire: str):
        self.html = page_of(pack(shown, fire), fire)
        """the whole page"""

    def save(self, path: Path) -> None:
        """Writes the page to a file."""
        path.write_text(self.html, encoding="utf-8")

    def __repr__(self) -> str:
        return f"<Replay, {len(self.html) // 1000} kB of HTML>"

    def _repr_html_(self) -> str:
        """Returns the page in a frame, for Jupyter."""
        return (
            f'<iframe srcdoc="{html.escape(self.html)}" title="Replay" sandbox="allow-scripts" '
            'style="width:100%;height:820px;border:0"></iframe>'
        )


def page_of(data: bytes, fire: str) -> str:
    """Returns the page of packed episodes.

    Args:
        data: result of `pack`.
        fire: name of the fire.
    """
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    return environment.from_string(_read("web", "page.html")).render(
        fire=fire,
        style=_read("web", "page.css"),
        uplot_style=_read("uplot", "uPlot.min.css"),
        uplot=_read("uplot", "uPlot.iife.min.js"),
        uplot_licence=_read("uplot", "LICENSE"),
        script=script(),
        data=base64.b64encode(data).decode(),
    )


@cache
def script() -> str:
    """Returns the modules of the page as one: their imports of each other are left out."""
    parts = (_IMPORT.sub("", _read("web", name)) for name in SCRIPTS)
    return "\n".join(_EXPORT.sub("", part) for part in parts)


@cache
def _read(*names: str) -> str:
    return files("emberlink.trainers.replay").joinpath(*names).read_text("utf-8")
