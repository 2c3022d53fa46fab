"""Pictures of an episode in the paper's colours (section IV.A)."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from .view import view_radius

NO_FIRE = (0, 0, 0)
FIRE = (255, 255, 255)
FIELD_OF_VIEW = (255, 255, 0)
UAV = (0, 0, 255)


def frame(
    fire_map: NDArray[np.uint8],
    position: NDArray[np.float32],
    *,
    view_angle: float,
    size: int = 360,
) -> NDArray[np.uint8]:
    """One picture: no fire black, fire white, field of view yellow, UAV blue.

    Args:
        fire_map: [X, Y], 0 where nothing burns.
        position: [n, 3], cells.
        view_angle: half the opening angle of the cameras, degrees.
        size: about how many pixels the longer side of the grid gets.

    Returns:
        uint8 [Y * scale, X * scale, 3]; x grows to the right and y upwards.
    """
    columns, rows = fire_map.shape
    scale = max(2, size // max(columns, rows))
    image = Image.new("RGB", (columns * scale, rows * scale), NO_FIRE)
    draw = ImageDraw.Draw(image)

    def square(x: float, y: float, half: float) -> tuple[float, float, float, float]:
        across, down = (x + 0.5) * scale, (rows - 0.5 - y) * scale
        return (
            across - half * scale,
            down - half * scale,
            across + half * scale - 1,
            down + half * scale - 1,
        )

    views = [square(x, y, view_radius(z, view_angle)) for x, y, z in position.tolist()]
    for box in views:
        draw.rectangle(box, fill=FIELD_OF_VIEW)
    for i, j in np.argwhere(fire_map > 0).tolist():
        draw.rectangle(square(i, j, 0.5), fill=FIRE)
    line = max(2, scale // 6)
    for left, top, right, bottom in views:
        # The black line shows the edge where yellow alone would not, over fire and other views.
        draw.rectangle((left - 1, top - 1, right + 1, bottom + 1), outline=NO_FIRE)
        draw.rectangle((left, top, right, bottom), outline=FIELD_OF_VIEW, width=line)
    for x, y, _ in position.tolist():
        draw.ellipse(square(x, y, max(0.45, 4 / scale)), fill=UAV)
    return np.asarray(image)


def write_gif(path: Path, frames: Iterable[NDArray[np.uint8]], *, fps: int = 20) -> None:
    """Writes frames, uint8 [height, width, 3] each, as an animation that repeats.

    Raises:
        ValueError: there is no frame.
    """
    images = [Image.fromarray(picture).quantize(32) for picture in frames]
    if not images:
        raise ValueError(f"{path}: an animation needs at least one frame")
    images[0].save(
        path, save_all=True, append_images=images[1:], duration=round(1000 / fps), loop=0
    )


class Window:
    """A window that shows pictures; it stays invisible where matplotlib has no screen."""

    def __init__(self, title: str):
        from matplotlib import pyplot  # imported here: only a window needs it

        self._pyplot = pyplot
        self._figure = pyplot.figure(num=title)
        self._image = None

    def show(self, picture: NDArray[np.uint8]) -> None:
        """Shows a picture, uint8 [height, width, 3], in place of the last one."""
        if self._image is None:
            axes = self._figure.add_axes((0, 0, 1, 1), frame_on=False, xticks=[], yticks=[])
            self._image = axes.imshow(picture)
            self._figure.show(warn=False)
        self._image.set_data(picture)
        self._figure.canvas.draw_idle()
        self._figure.canvas.flush_events()

    def close(self) -> None:
        self._pyplot.close(self._figure)
