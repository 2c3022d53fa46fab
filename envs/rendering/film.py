"""Writes frames as a GIF, or with ffmpeg as an MP4 video."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any, cast

import imageio_ffmpeg
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from emberlink.envs.utils.errors import UserError

_PALETTE = 256  # colours of a GIF
_COLOURS = (
    "scale=out_color_matrix=bt709:out_range=tv,"
    "setparams=color_primaries=bt709:color_trc=bt709:colorspace=bt709:range=tv"
)

# H.264 with 4:2:0 chroma, which all browsers support. A constant rate factor of 18 and the tune
# for animations preserve flat colours and sharp edges. The colour matrix is stored, so that players
# do not guess it. With "faststart" a video can start before it is loaded completely.
_OPTIONS = [
    *("-crf", "18", "-preset", "medium", "-tune", "animation"),
    *("-vf", _COLOURS),
    *("-threads", "1", "-movflags", "+faststart", "-f", "mp4"),
]


def write_gif(path: Path, frames: Iterable[NDArray[np.uint8]], *, fps: int = 20) -> None:
    """Writes frames, uint8 [height, width, 3] each, as a GIF that repeats.

    Raises:
        ValueError: there is no frame.
    """
    images = [Image.fromarray(picture).quantize(_PALETTE) for picture in frames]
    if not images:
        raise ValueError(f"{path}: an animation needs at least one frame")
    images = _share_palette(images)
    duration = round(1000 / fps)
    images[0].save(
        path,
        "GIF",
        save_all=True,
        append_images=images[1:],
        duration=duration,
        loop=0,
        optimize=False,
    )


def _share_palette(images: list[Image.Image]) -> list[Image.Image]:
    """Converts images to a common palette if all their colours fit into it.

    Pixels that do not change between frames then take almost no space in the file.
    """
    colours: dict[bytes, int] = {}
    tables: list[list[int]] = []
    for image in images:
        palette = bytes(image.getpalette() or ())
        entries = (palette[i : i + 3] for i in range(0, len(palette), 3))
        tables.append([colours.setdefault(entry, len(colours)) for entry in entries])
    # One entry must be free for pixels that do not change.
    if len(colours) >= _PALETTE:
        return images
    shared = []
    for image, table in zip(images, tables, strict=True):
        numbers = np.array(table, np.uint8)[np.asarray(image)]
        renumbered = Image.fromarray(numbers, "P")
        renumbered.putpalette(b"".join(colours))
        shared.append(renumbered)
    return shared


def write_mp4(path: Path, frames: Iterable[NDArray[np.uint8]], *, fps: int = 20) -> None:
    """Writes frames, uint8 [height, width, 3] each, both sides even, as a video.

    Raises:
        UserError: ffmpeg failed, or did not write all frames.
        OSError: the file cannot be written.
        ValueError: there is no frame.
    """
    path.touch()  # raises an error that names the path; ffmpeg's does not
    path = path.absolute()  # ffmpeg takes `fire:3.mp4` for an address and `-x.mp4` for an option
    written, writer = 0, None
    try:
        for picture in frames:
            if writer is None:
                writer = _start(path, picture, fps)
            writer.send(np.ascontiguousarray(picture))
            written += 1
        if writer is not None:
            writer.close()
        complete = written > 0 and imageio_ffmpeg.count_frames_and_secs(path)[0] == written
    except (OSError, RuntimeError) as error:
        reason = str(error).strip().splitlines()[0]
        raise UserError(f"{path.name}: ffmpeg failed: {reason}") from None
    if written == 0:
        raise ValueError(f"{path}: a video needs at least one frame")
    if not complete:
        raise UserError(f"{path.name}: ffmpeg failed: not all {written} frames were written")


def _start(path: Path, picture: NDArray[np.uint8], fps: int):
    """Starts ffmpeg for frames of the size of `picture`."""
    height, width = picture.shape[:2]
    writer = imageio_ffmpeg.write_frames(
        path,
        (width, height),
        fps=fps,
        codec="libx264",
        quality=cast(Any, None),  # the rate factor is among the options
        macro_block_size=2,
        ffmpeg_log_level="quiet",
        output_params=_OPTIONS,
    )
    writer.send(None)
    return writer
