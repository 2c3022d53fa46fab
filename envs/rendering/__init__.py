"""Pictures, animations and videos of episodes."""

from typing import TYPE_CHECKING

from emberlink.envs.utils.lazy import lazy

if TYPE_CHECKING:
    from emberlink.envs.rendering.frame import Chart, write_gif
    from emberlink.envs.rendering.marks import FrameData
    from emberlink.envs.rendering.panels import Episode, Screen
    from emberlink.envs.rendering.video import write_mp4
    from emberlink.envs.rendering.window import Window

__all__ = ["Chart", "Episode", "FrameData", "Screen", "Window", "write_gif", "write_mp4"]

__getattr__ = lazy(
    __name__,
    {
        "Chart": "frame",
        "Episode": "panels",
        "FrameData": "marks",
        "Screen": "panels",
        "Window": "window",
        "write_gif": "frame",
        "write_mp4": "video",
    },
)
