"""Shows frames in a matplotlib window."""

from typing import Any

import numpy as np
from numpy.typing import NDArray


class Window:
    """Shows frames in a window; nothing is shown if matplotlib has no display.

    Args:
        title: of the window.
    """

    def __init__(self, title: str):
        from matplotlib import pyplot  # imported here, since it takes a second

        self._pyplot = pyplot
        self._figure = pyplot.figure()  # a title as its name would share it with other windows
        manager: Any = self._figure.canvas.manager
        manager.set_window_title(title)
        self._image: Any = None

    def show(self, picture: NDArray[np.uint8]) -> None:
        """Shows a frame, uint8 [height, width, 3], in place of the previous one."""
        if self._image is None:
            axes = self._figure.add_axes((0, 0, 1, 1), frame_on=False, xticks=[], yticks=[])
            self._image = axes.imshow(picture)
            self._figure.show(warn=False)
        self._image.set_data(picture)
        self._figure.canvas.draw_idle()
        self._figure.canvas.flush_events()

    def close(self) -> None:
        """Closes the window."""
        self._pyplot.close(self._figure)
