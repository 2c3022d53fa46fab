"""Records episodes and shows them on a page of HTML that plays them back."""

from typing import TYPE_CHECKING

from emberlink.envs.utils.lazy import lazy

if TYPE_CHECKING:
    from emberlink.trainers.replay.page import Replay
    from emberlink.trainers.replay.record import Recorder

__all__ = ["Recorder", "Replay"]

__getattr__ = lazy(__name__, {"Recorder": "record", "Replay": "page"})
