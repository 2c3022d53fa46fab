"""Pictures, animations and videos of episodes."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from emberlink.envs.rendering.frame import Chart, write_gif
    from emberlink.envs.rendering.marks import FrameData
    from emberlink.envs.rendering.panels import Episode, Screen
    from emberlink.envs.rendering.video import write_mp4
    from emberlink.envs.rendering.window import Window

__all__ = ["Chart", "Episode", "FrameData", "Screen", "Window", "write_gif", "write_mp4"]

_FILES = {
    "Chart": "frame",
    "Episode": "panels",
    "FrameData": "marks",
    "Screen": "panels",
    "Window": "window",
    "write_gif": "frame",
    "write_mp4": "video",
}


def __getattr__(name: str) -> Any:
    # Imported when asked for: an environment needs none of them but `frame`.
    if name in _FILES:
        return getattr(import_module(f"{__name__}.{_FILES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
