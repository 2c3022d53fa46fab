"""Draws episodes side by side: a map with marks and a title for each, and a legend."""

import math
from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from emberlink.envs.rendering import frame
from emberlink.envs.rendering.frame import Chart, Colour, Pen
from emberlink.trainers.replay.recording import ROLES, Episode, Recording

SEEN_FIRE = (140, 140, 140)
"""colour of seen fire where seen and unseen fire differ (paper, figure 2)"""
LINK = (0, 200, 255)
LINK_WIDTHS = {frame.NO_FIRE: 4, LINK: 2}
"""width in pixels of each line of a link; the dark edge is drawn first"""
TARGET = (255, 140, 0)
ROLE_COLOURS = ((230, 0, 60), (0, 150, 60), (215, 215, 215))
MANY = 16
"""number of UAVs above which links are thin and lines to targets are left out"""
_PAPER, _INK = (40, 40, 44), (240, 240, 240)
_GAP, _LINE = 10, 20
_HEADER = 2 * _LINE + 4
_NARROWEST = 250  # minimum width of a panel in pixels, for its title
_TEXT = 15
_SAMPLE = 30  # width of the sample before the text of a legend entry

# Corners of the shape of each role: offsets to the right and downwards, in half widths.
_SHAPES = (
    ((0, -1.3), (1.3, 0), (0, 1.3), (-1.3, 0)),
    ((0, -1.4), (1.35, 1), (-1.35, 1)),
    ((-1, -1), (1, -1), (1, 1), (-1, 1)),
)

Sample = Callable[[Pen, float, float], None]


class Screen:
    """Draws the same step of several episodes, of one grid and horizon, into one picture.

    A map's longer side has about `size` pixels; seen fire is grey if `grey_seen`.
    """

    def __init__(self, episodes: Sequence[Episode], *, size: int, grey_seen: bool = False):
        self._episodes, self._grey_seen = episodes, grey_seen
        grid = episodes[0].recording.world.grid
        self.scale = scale_of(grid, size)
        self.map_size = grid[0] * self.scale, grid[1] * self.scale
        self._font = ImageFont.load_default(_TEXT)
        panel = max(self.map_size[0], _NARROWEST) + _GAP, self.map_size[1] + _HEADER + _GAP
        columns = _columns(len(episodes), *panel)
        rows = math.ceil(len(episodes) / columns)
        self._corners = [
            (_GAP + i % columns * panel[0], _GAP + i // columns * panel[1])
            for i in range(len(episodes))
        ]
        width, top, legend = columns * panel[0] + _GAP, rows * panel[1] + _GAP, self.legend()
        places, used = self._wrap([*legend], width)
        height = top + used + _GAP
        # Videos need even sides.
        self._blank = Image.new("RGB", (width + width % 2, height + height % 2), _PAPER)
        pen = ImageDraw.Draw(self._blank)
        for (x, y), (word, sample) in zip(places, legend.items(), strict=True):
            sample(pen, x + 10, top + y + _LINE / 2)
            self._write(pen, x + _SAMPLE, top + y, word)
        for (x, y), episode in zip(self._corners, episodes, strict=True):
            self._write(pen, x, y, self._shortened(episode.title, panel[0] - _GAP))

    def map_corner(self, panel: int) -> tuple[int, int]:
        """Returns the upper left pixel of a panel's map, (x, y)."""
        x, y = self._corners[panel]
        return x, y + _HEADER

    def picture(self, step: int) -> NDArray[np.uint8]:
        """Draws a step of all episodes, uint8 [height, width, 3], both sides even."""
        image = self._blank.copy()
        pen = ImageDraw.Draw(image)
        seen = SEEN_FIRE if self._grey_seen else frame.FIRE
        for panel, episode in enumerate(self._episodes):
            drawn = draw_map(episode.recording, step, scale=self.scale, seen_fire=seen)
            image.paste(drawn, self.map_corner(panel))
            x, y = self._corners[panel]
            covered = f"step {step}   coverage {episode.recording.coverage(step):.1f} %"
            self._write(pen, x, y + _LINE, covered)
        return np.asarray(image)

    def _write(self, pen: Pen, x: float, y: float, text: str) -> None:
        pen.text((x, y + _LINE / 2), text, fill=_INK, font=self._font, anchor="lm")

    def _shortened(self, text: str, width: float) -> str:
        """Cuts the middle of a text to fit a width; its end often names how panels differ."""
        kept, cut = len(text), text
        while kept and self._font.getlength(cut) > width:
            kept -= 1
            cut = f"{text[: -(-kept // 2)]}…{text[len(text) - kept // 2 :]}"
        return cut

    def _wrap(self, words: Sequence[str], most: int) -> tuple[list[tuple[float, float]], int]:
        """Returns the position of each legend entry, and the height of the legend."""
        places: list[tuple[float, float]] = []
        x, y = _GAP, 0
        for word in words:
            width = _SAMPLE + math.ceil(self._font.getlength(word)) + 2 * _GAP
            if x > _GAP and x + width > most + _GAP:
                x, y = _GAP, y + _LINE
            places.append((x, y))
            x += width
        return places, y + _LINE

    def legend(self) -> dict[str, Sample]:
        """Returns the text and a sample of each legend entry, for the marks that occur."""
        shown = [episode.recording for episode in self._episodes]
        roles = ["follows" in one.steps for one in shown]
        half = _mark_size(self.scale)
        target = ROLE_COLOURS[0] if any(roles) else TARGET
        last = [one.fire_map(one.horizon) for one in shown]
        occurs: list[tuple[bool, str, Sample]] = [
            (True, "fire", _box(frame.FIRE)),
            (self._grey_seen, "fire, seen", _box(SEEN_FIRE)),
            (True, "field of view", _box(frame.FIELD_OF_VIEW)),
            (not all(roles), "UAV", _uav_sample(half, None)),
            *((any(roles), name, _uav_sample(half, role)) for role, name in enumerate(ROLES)),
            (any(one.listens for one in shown), "hear each other", _link_sample),
            (any("target" in one.steps for one in shown), "target", _target_sample(target)),
            (any(one.world.base for one in shown), "base", _base_sample),
            (any(not one.steps["alive"].all() for one in shown), "failed", _failed_sample),
            (any((fire == 3).any() for fire in last), "burnt out, seen", _box(frame.BURNT_OUT)),
            (any((fire == 4).any() for fire in last), "burnt out, not seen", _box(frame.MISSED)),
        ]
        return {word: sample for shown, word, sample in occurs if shown}


def draw_map(
    episode: Recording, step: int, *, scale: int, seen_fire: Colour = frame.FIRE
) -> Image.Image:
    """Returns the map of an episode at a step with links, targets, and UAVs in their roles."""
    now = {name: values[step] for name, values in episode.steps.items()}
    chart = Chart(
        episode.fire_map(step),
        now["position"],
        view_angle=episode.world.view_angle,
        scale=scale,
        seen_fire=seen_fire,
        alive=now["alive"],
        base=episode.world.base,
    )
    places = [chart.point(x, y) for x, y, _ in now["position"].tolist()]
    half, roles, few = _mark_size(scale), episode.roles(step), len(places) <= MANY
    if episode.listens:
        radios = [*places, *([chart.point(*episode.world.base)] if episode.world.base else [])]
        pairs = np.argwhere(np.triu(now["hears"] | now["hears"].T, 1)).tolist()
        # The dark edges of many links would hide the map.
        for colour, width in (LINK_WIDTHS if few else {LINK: 1}).items():
            for i, j in pairs:
                chart.pen.line((radios[i], radios[j]), fill=colour, width=width)
    flying = [uav for uav, flies in enumerate(now["alive"]) if flies]
    for uav in flying if "target" in now else ():
        end, role = chart.point(*now["target"][uav, :2].tolist()), roles[uav]
        colour = TARGET if role is None else ROLE_COLOURS[role]
        if few:
            _dashes(chart.pen, places[uav], end, colour)
        frame.draw_cross(chart.pen, end, half * 0.6, colour)
    for uav, (place, role) in enumerate(zip(places, roles, strict=True)):
        if uav not in flying:
            frame.draw_cross(chart.pen, place, half, frame.FAILED)
        elif role is None:
            chart.draw_uav(*now["position"][uav, :2].tolist())
        else:
            _draw_uav(chart.pen, place, half, role)
    return chart.image


def even_steps(horizon: int, frames: int) -> list[int]:
    """Returns at most `frames` steps, evenly spread from 0 to the horizon."""
    steps = np.linspace(0, horizon, min(frames, horizon + 1)).round().astype(int)
    return steps.tolist()


def scale_of(grid: Sequence[int], size: int) -> int:
    """Returns pixels per cell, so that the longer side has about `size` pixels.

    A narrow map is drawn up to twice as large.
    """
    longer, shorter = max(grid), min(grid)
    wide = min(2 * size // longer, math.ceil(size / 4 / shorter))
    return max(2, size // longer, wide)


def _mark_size(scale: int) -> float:
    """Returns half the width of a UAV's mark, pixels, on a chart of `scale` pixels per cell."""
    return min(max(0.55 * scale, 6.0), 9.0)


def _columns(count: int, width: int, height: int) -> int:
    """Returns the number of columns for which the panels fit into the smallest square."""

    def side(columns: int) -> int:
        return max(columns * width, math.ceil(count / columns) * height)

    return min(range(1, count + 1), key=lambda columns: (side(columns), -columns))


def _dashes(pen: Pen, start: tuple[float, float], end: tuple[float, float], colour: Colour) -> None:
    """Draws a thin line with dashes and gaps of 4 pixels."""
    offset = np.subtract(end, start)
    length = float(np.hypot(*offset))
    for dash, (near, far) in enumerate(pairwise([*np.arange(0, length, 4), length])):
        if dash % 2 == 0:
            points = (tuple(np.add(start, offset * (stop / length))) for stop in (near, far))
            pen.line(tuple(points), fill=colour)


def _draw_uav(pen: Pen, place: tuple[float, float], half: float, role: int | None) -> None:
    """Draws a UAV as a blue disc, within a shape in the colour of its role if it has one."""
    x, y = place
    if role is not None:
        corners = [(x + half * right, y + half * down) for right, down in _SHAPES[role]]
        pen.polygon(corners, fill=ROLE_COLOURS[role], outline=frame.NO_FIRE)
        half *= 0.5
    pen.ellipse((x - half, y - half, x + half, y + half), fill=frame.UAV)


# Samples of the legend


def _box(colour: Colour) -> Sample:
    def sample(pen: Pen, x: float, y: float) -> None:
        pen.rectangle((x - 8, y - 6, x + 8, y + 6), fill=colour, outline=frame.NO_FIRE)

    return sample


def _uav_sample(half: float, role: int | None) -> Sample:
    def sample(pen: Pen, x: float, y: float) -> None:
        pen.rectangle((x - 9, y - 9, x + 9, y + 9), fill=frame.FIELD_OF_VIEW)
        _draw_uav(pen, (x, y), half, role)

    return sample


def _link_sample(pen: Pen, x: float, y: float) -> None:
    for colour, width in LINK_WIDTHS.items():
        pen.line((x - 8, y, x + 10, y), fill=colour, width=width)


def _target_sample(colour: Colour) -> Sample:
    def sample(pen: Pen, x: float, y: float) -> None:
        _dashes(pen, (x - 8, y), (x + 5, y), colour)
        frame.draw_cross(pen, (x + 5, y), 4, colour)

    return sample


def _base_sample(pen: Pen, x: float, y: float) -> None:
    frame.draw_base(pen, (x, y), 6)


def _failed_sample(pen: Pen, x: float, y: float) -> None:
    frame.draw_cross(pen, (x, y), 6, frame.FAILED)
