"""Draws episodes side by side: a map with marks and a title for each, and a legend."""

import math
import textwrap
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from emberlink.envs.rendering import frame
from emberlink.envs.rendering.frame import DPI, mark
from emberlink.trainers.replay.recording import ROLES, Recording

SEEN_FIRE = "#8c8c8c"
"""colour of seen fire where seen and unseen fire differ (paper, figure 2)"""
LINK = "#00c8ff"
NO_ROLE = "#ff8c00"
"""colour of the targets of UAVs without a role"""
ROLE_MARKS: tuple[dict[str, Any], ...] = (
    {"color": "#e6003c", "marker": "D", "ms": 11, "mec": frame.NO_FIRE},
    {"color": "#00963c", "marker": "^", "ms": 15, "mec": frame.NO_FIRE},
    {"color": "#d7d7d7", "marker": "s", "ms": 12, "mec": frame.NO_FIRE},
)
"""mark behind a UAV in each of `ROLES`"""
TARGET: dict[str, Any] = {"marker": "x", "ms": 6, "mew": 1.5}
MANY = 16
"""number of UAVs above which links are thin and lines to targets are left out"""
_PAPER, _INK = "#28282c", "#f0f0f0"
_NARROWEST = 250  # minimum width of a panel in pixels, for its title
_LINE, _LETTER, _ENTRY = 18, 7.5, 160  # height of a line, widths of a letter and a legend entry


class Screen:
    """Draws the same step of several episodes, of one grid and horizon, into one picture.

    A map's longer side has about `size` pixels; seen fire is grey if `grey_seen`.
    """

    def __init__(self, episodes: Sequence[Recording], *, size: int, grey_seen: bool = False):
        self._episodes, self._grey_seen = episodes, grey_seen
        grid, count = episodes[0].world.grid, len(episodes)
        width, height = (size * side / max(grid) for side in grid)
        width = max(width, _NARROWEST)
        columns = min(count, math.ceil(math.sqrt(count * height / width)))
        titles = [textwrap.fill(one.title, int(width / _LETTER)) for one in episodes]
        self._titles = [f"{title}\nstep {{}}   coverage {{:.1f}} %" for title in titles]
        height += _LINE * (2 + max(title.count("\n") for title in self._titles))
        rows = math.ceil(count / columns)
        legend, per_line = self.legend(), max(1, int(columns * width / _ENTRY))
        total = columns * width, rows * height + _LINE * (1 + math.ceil(len(legend) / per_line))
        inches: Any = [2 * round(pixels / 2) / DPI for pixels in total]  # even, as videos need
        self.figure = Figure(figsize=inches, dpi=DPI, layout="constrained", facecolor=_PAPER)
        self.axes: list[Axes] = list(self.figure.subplots(rows, columns, squeeze=False).flat)
        place = {"loc": "outside lower left", "ncols": per_line, "frameon": False}
        self.figure.legend(handles=legend, labelcolor=_INK, fontsize="small", **place)
        self._canvas = FigureCanvasAgg(self.figure)
        self._blank: Any = None
        self.picture(0)
        self._canvas.draw()  # finds the layout, which stays
        self.figure.set_layout_engine("none")
        for axes in self.axes:
            axes.set_visible(False)
        self._canvas.draw()  # the legend, once for all pictures
        self._blank = self._canvas.copy_from_bbox(self.figure.bbox)

    def picture(self, step: int) -> NDArray[np.uint8]:
        """Draws a step of all episodes, uint8 [height, width, 3], both sides even."""
        if self._blank is not None:
            self._canvas.restore_region(self._blank)
        seen = SEEN_FIRE if self._grey_seen else frame.FIRE
        for axes, title, episode in zip(self.axes, self._titles, self._episodes, strict=False):
            for earlier in (*axes.images, *axes.collections, *axes.lines):
                earlier.remove()
            axes.set_visible(True)
            draw_step(axes, episode, step, seen_fire=seen)
            text = title.format(step, episode.coverage(step))
            axes.set_title(text, loc="left", color=_INK, fontsize=10, parse_math=False)
            axes.draw_artist(axes)
        return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()

    def legend(self) -> list[Line2D]:
        """Returns a sample with a label for each mark that occurs."""
        shown = self._episodes
        last = [one.fire_map(one.horizon) for one in shown]
        roles = ["follows" in one.steps for one in shown]
        target = ROLE_MARKS[0]["color"] if any(roles) else NO_ROLE
        occurs: list[tuple[bool, str, dict[str, Any]]] = [
            (True, "fire", _cell(frame.FIRE)),
            (self._grey_seen, "fire, seen", _cell(SEEN_FIRE)),
            (True, "field of view", _cell(frame.FIELD_OF_VIEW)),
            (True, "UAV", frame.UAV),
            *((any(roles), name, style) for name, style in zip(ROLES, ROLE_MARKS, strict=True)),
            (any(one.listens for one in shown), "hear each other", {"color": LINK, "ls": "-"}),
            (any("target" in one.steps for one in shown), "target", {**TARGET, "color": target}),
            (any(one.world.base for one in shown), "base", frame.BASE),
            (any(not one.steps["alive"].all() for one in shown), "failed", frame.FAILED),
            (any((fire == 3).any() for fire in last), "burnt out, seen", _cell(frame.BURNT_OUT)),
            (any((fire == 4).any() for fire in last), "burnt out, not seen", _cell(frame.MISSED)),
        ]
        return [Line2D([], [], label=n, **{"ls": "", **s}) for shown, n, s in occurs if shown]


def draw_step(axes: Axes, episode: Recording, step: int, *, seen_fire: str = frame.FIRE) -> None:
    """Draws the map of an episode at a step with links, targets, and UAVs in their roles."""
    now = {name: values[step] for name, values in episode.steps.items()}
    world, alive, places = episode.world, now["alive"], now["position"][:, :2]
    about = {"view_angle": world.view_angle, "alive": alive, "base": world.base}
    frame.draw_map(axes, episode.fire_map(step), now["position"], seen_fire=seen_fire, **about)
    few = len(places) <= MANY
    if episode.listens:
        radios = np.concatenate((places, [world.base])) if world.base else places
        links = radios[np.argwhere(np.triu(now["hears"] | now["hears"].T, 1))]
        # The dark edges of many links would hide the map.
        for colour, width in {frame.NO_FIRE: 3.0, LINK: 1.5}.items() if few else ((LINK, 0.75),):
            _lines(axes, links, colors=colour, linewidths=width)
    roles = np.full(len(places), None)
    if "follows" in now:
        follows_other = now["follows"] != np.arange(len(places))
        roles = np.where(now["follows"] < 0, 2, follows_other)
    for role in dict.fromkeys(roles[alive]):
        of_role = alive & (roles == role)
        style = {"color": NO_ROLE} if role is None else ROLE_MARKS[role]
        if role is not None:
            mark(axes, places[of_role], zorder=4, **style)
        if "target" in now:
            targets = now["target"][of_role, :2]
            mark(axes, targets, **TARGET, color=style["color"])
            if few:
                lines = np.stack((places[of_role], targets), 1)
                _lines(axes, lines, colors=style["color"], linestyles=(0, (3, 3)), linewidths=1)


def even_steps(horizon: int, frames: int) -> list[int]:
    """Returns at most `frames` steps, evenly spread from 0 to the horizon."""
    steps = np.linspace(0, horizon, min(frames, horizon + 1)).round().astype(int)
    return steps.tolist()


def _lines(axes: Axes, lines: NDArray[Any], **style: Any) -> None:
    """Draws lines, [k, 2, 2] in cells."""
    drawn = LineCollection(list(lines), zorder=3, antialiaseds=False, **style)
    axes.add_collection(drawn, autolim=False)


def _cell(colour: str) -> dict[str, Any]:
    """Returns the sample of a cell."""
    return {"color": colour, "marker": "s", "ms": 11, "mec": frame.NO_FIRE}
