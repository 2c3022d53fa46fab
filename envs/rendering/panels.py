"""Draws episodes side by side: a panel with a title for each, and a legend."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from emberlink.envs.rendering import marks
from emberlink.envs.rendering.frame import (
    BURNT_OUT,
    FAILED,
    FIELD_OF_VIEW,
    FIRE,
    MISSED,
    NO_FIRE,
    Chart,
    draw_base,
    draw_cross,
)
from emberlink.envs.rendering.marks import ROLE_COLOURS, ROLES, TARGET, FrameData

SEEN_FIRE = (140, 140, 140)
"""colour of seen fire if it differs from that of unseen fire (paper, figure 2)"""
PAPER = (40, 40, 44)
INK = (240, 240, 240)
GAP = 10
LINE = 20
HEADER = 2 * LINE + 4
NARROWEST = 250
"""minimum width of a panel in pixels, for its title"""
_TEXT = 15
_SAMPLE = 30  # width of the sample before the text of a legend entry

Sample = Callable[[ImageDraw.ImageDraw, float, float], None]


@dataclass(frozen=True, kw_only=True)
class Episode:
    """An episode in one panel."""

    title: str
    view_angle: float
    """half the opening angle of the cameras, degrees"""
    frames: Sequence[FrameData]


class Screen:
    """Draws the same frame of several episodes into one picture.

    Args:
        episodes: episodes with the same grid size and number of frames.
        size: approximate pixels of a map's longer side.
        grey_seen: whether seen fire is grey.
    """

    def __init__(self, episodes: Sequence[Episode], *, size: int, grey_seen: bool = False):
        self._episodes, self._grey_seen = episodes, grey_seen
        grid = episodes[0].frames[0].fire_map.shape
        self.scale = scale_of(grid, size)
        self.map_size = grid[0] * self.scale, grid[1] * self.scale
        self._font = ImageFont.load_default(_TEXT)
        panel = max(self.map_size[0], NARROWEST) + GAP, self.map_size[1] + HEADER + GAP
        columns = _columns(len(episodes), *panel)
        rows = math.ceil(len(episodes) / columns)
        self._corners = [
            (GAP + i % columns * panel[0], GAP + i // columns * panel[1])
            for i in range(len(episodes))
        ]
        self.width = _even(columns * panel[0] + GAP)
        top = rows * panel[1] + GAP
        legend = list(self._legend())
        places, used = self._wrap([word for word, _ in legend])
        self.height = _even(top + used + GAP)
        self._blank = Image.new("RGB", (self.width, self.height), PAPER)
        draw = ImageDraw.Draw(self._blank)
        for (x, y), (word, sample) in zip(places, legend, strict=True):
            sample(draw, x + 10, top + y + LINE / 2)
            self._write(draw, x + _SAMPLE, top + y, word)
        for (x, y), episode in zip(self._corners, episodes, strict=True):
            self._write(draw, x, y, self._cut(episode.title, panel[0] - GAP))

    def map_corner(self, panel: int) -> tuple[int, int]:
        """Returns the upper left pixel of a panel's map, (x, y)."""
        x, y = self._corners[panel]
        return x, y + HEADER

    def picture(self, index: int) -> NDArray[np.uint8]:
        """Draws frame `index` of all episodes, uint8 [height, width, 3], both sides even."""
        image = self._blank.copy()
        draw = ImageDraw.Draw(image)
        for panel, episode in enumerate(self._episodes):
            data = episode.frames[index]
            chart = Chart(
                data.fire_map,
                data.position,
                view_angle=episode.view_angle,
                scale=self.scale,
                seen_fire=SEEN_FIRE if self._grey_seen else FIRE,
                alive=data.alive,
                base=data.base,
            )
            marks.draw_marks(chart, data)
            image.paste(chart.image, self.map_corner(panel))
            x, y = self._corners[panel]
            text = f"step {data.step}   coverage {data.coverage:.1f} %"
            self._write(draw, x, y + LINE, text)
        return np.asarray(image)

    def _write(self, draw: ImageDraw.ImageDraw, x: float, y: float, text: str) -> None:
        draw.text((x, y + LINE / 2), text, fill=INK, font=self._font, anchor="lm")

    def _cut(self, text: str, width: float) -> str:
        """Returns the text, shortened in its middle to fit a width in pixels.

        The end often names the setting in which panels differ.
        """
        if self._font.getlength(text) <= width:
            return text
        kept = len(text)
        while kept and self._font.getlength(_without_middle(text, kept)) > width:
            kept -= 1
        return _without_middle(text, kept)

    def _wrap(self, words: Sequence[str]) -> tuple[list[tuple[float, float]], int]:
        """Returns the position of each legend entry, and the height of the legend."""
        places: list[tuple[float, float]] = []
        x, y = GAP, 0
        for word in words:
            width = _SAMPLE + math.ceil(self._font.getlength(word)) + 2 * GAP
            if x > GAP and x + width > self.width + GAP:
                x, y = GAP, y + LINE
            places.append((x, y))
            x += width
        return places, y + LINE

    def _legend(self) -> Sequence[tuple[str, Sample]]:
        """Returns the text and a sample of each legend entry, for the marks that occur."""

        def occurs(name: str) -> list[bool]:
            return [getattr(e.frames[0], name) is not None for e in self._episodes]

        half = marks.mark_size(self.scale)
        shown: list[tuple[str, Sample]] = []
        shown.append(("fire", _box(FIRE)))
        if self._grey_seen:
            shown.append(("fire, seen", _box(SEEN_FIRE)))
        shown.append(("field of view", _box(FIELD_OF_VIEW)))
        roles, links, target = occurs("roles"), occurs("links"), occurs("target")
        if not all(roles):
            shown.append(("UAV", _uav(half, None)))
        if any(roles):
            shown += [(name, _uav(half, role)) for role, name in enumerate(ROLES)]
        if any(links):
            shown.append(("hear each other", _link))
        if any(target):
            shown.append(("target", _cross(ROLE_COLOURS[0] if any(roles) else TARGET)))
        if any(occurs("base")):
            shown.append(("base", _base))
        frames = [frame for episode in self._episodes for frame in episode.frames]
        if any(not frame.flies(uav) for frame in frames for uav in range(len(frame.position))):
            shown.append(("failed", _failed))
        burnt_out = (("burnt out, seen", BURNT_OUT, 3), ("burnt out, not seen", MISSED, 4))
        for text, colour, value in burnt_out:
            if any((frame.fire_map == value).any() for frame in frames):
                shown.append((text, _box(colour)))
        return shown


def scale_of(grid: Sequence[int], size: int) -> int:
    """Returns pixels per cell, so that the longer side has about `size` pixels.

    A narrow map is drawn up to twice as large.
    """
    longer, shorter = max(grid), min(grid)
    wide = min(2 * size // longer, math.ceil(size / 4 / shorter))
    return max(2, size // longer, wide)


def _columns(count: int, width: int, height: int) -> int:
    """Returns the number of columns for which the panels fit into the smallest square."""

    def side(columns: int) -> int:
        return max(columns * width, math.ceil(count / columns) * height)

    return min(range(1, count + 1), key=lambda columns: (side(columns), -columns))


def _even(pixels: int) -> int:
    return pixels + pixels % 2


def _box(colour: tuple[int, int, int]) -> Sample:
    def sample(draw: ImageDraw.ImageDraw, x: float, y: float) -> None:
        draw.rectangle((x - 8, y - 6, x + 8, y + 6), fill=colour, outline=NO_FIRE)

    return sample


def _uav(half: float, role: int | None) -> Sample:
    def sample(draw: Any, x: float, y: float) -> None:
        draw.rectangle((x - 9, y - 9, x + 9, y + 9), fill=FIELD_OF_VIEW)
        marks.uav(draw, (x, y), half, role)

    return sample


def _link(draw: ImageDraw.ImageDraw, x: float, y: float) -> None:
    for colour, width in marks.LINK_WIDTHS.items():
        draw.line((x - 8, y, x + 10, y), fill=colour, width=width)


def _cross(colour: tuple[int, int, int]) -> Sample:
    def sample(draw: Any, x: float, y: float) -> None:
        marks.dashes(draw, (x - 8, y), (x + 5, y), colour)
        draw_cross(draw, (x + 5, y), 4, colour)

    return sample


def _base(draw: ImageDraw.ImageDraw, x: float, y: float) -> None:
    draw_base(draw, (x, y), 6)


def _failed(draw: ImageDraw.ImageDraw, x: float, y: float) -> None:
    draw_cross(draw, (x, y), 6, FAILED)


def _without_middle(text: str, kept: int) -> str:
    """Returns the first and last characters of a text with dots between them."""
    first, last = -(-kept // 2), kept // 2
    return f"{text[:first]}…{text[len(text) - last :]}"
