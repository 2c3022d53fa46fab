"""Writes frames as a GIF, or with ffmpeg as an MP4 video."""

from collections.abc import Iterable
from contextlib import suppress
from itertools import chain
from pathlib import Path
from subprocess import PIPE, Popen
from typing import Any, cast

import imageio_ffmpeg
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from emberlink.envs.utils.errors import UserError

# H.264 with 4:2:0 chroma, which all browsers support. A constant rate factor of 18 and the tune
# for animations preserve flat colours and sharp edges. With "faststart" a video can start before it
# is loaded completely.
_OPTIONS = [
    *("-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "18", "-tune", "animation"),
    *("-threads", "1", "-movflags", "+faststart", "-f", "mp4"),
]


def write_gif(path: Path, frames: Iterable[NDArray[np.uint8]], *, fps: int = 20) -> None:
    """Writes frames, uint8 [height, width, 3] each, as a GIF that repeats."""
    images, time = map(Image.fromarray, frames), round(1000 / fps)
    next(images).save(path, "GIF", save_all=True, append_images=images, duration=time, loop=0)


def write_mp4(path: Path, frames: Iterable[NDArray[np.uint8]], *, fps: int = 20) -> None:
    """Writes frames, uint8 [height, width, 3] each, both sides even, as a video.

    Raises:
        UserError: ffmpeg failed.
    """
    frames = iter(frames)
    first = next(frames)
    raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{first.shape[1]}x{first.shape[0]}"]
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-v", "error", *raw, "-r", str(fps)]
    command += ["-i", "-", *_OPTIONS, f"file:{path.absolute()}"]
    with Popen(command, stdin=PIPE, stderr=PIPE) as ffmpeg:
        with suppress(BrokenPipeError):  # its status tells why
            for picture in chain([first], frames):
                cast(Any, ffmpeg.stdin).write(picture.tobytes())
        said = ffmpeg.communicate()[1].decode(errors="replace").strip().splitlines()
    if ffmpeg.returncode:
        reason = said[0] if said else f"status {ffmpeg.returncode}"
        raise UserError(f"{path.name}: ffmpeg failed: {reason}")
