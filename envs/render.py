"""Pictures of an episode in the paper's colours (section IV.A)."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from .uav import view_radius

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
    for box in views:
        draw.rectangle(box, outline=FIELD_OF_VIEW, width=max(1, scale // 6))
    for x, y, _ in position.tolist():
        draw.ellipse(square(x, y, 0.45), fill=UAV)
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
