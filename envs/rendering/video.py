"""Videos that browsers play, written by ffmpeg."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any, cast

import imageio_ffmpeg
import numpy as np
from numpy.typing import NDArray

from emberlink.envs.utils.errors import UserError

_COLOURS = (
    "scale=out_color_matrix=bt709:out_range=tv,"
    "setparams=color_primaries=bt709:color_trc=bt709:colorspace=bt709:range=tv"
)

# H.264 in 4:2:0, as every browser has it. Flat colours stay clean at a constant rate factor of 18,
# and the tune for drawings keeps edges sharp; the matrix is written down so that players do not
# guess it; with the index at the front a video starts before all of it has come.
_OPTIONS = [
    *("-crf", "18", "-preset", "medium", "-tune", "animation"),
    *("-vf", _COLOURS),
    *("-threads", "1", "-movflags", "+faststart", "-f", "mp4"),
]


def write_mp4(path: Path, frames: Iterable[NDArray[np.uint8]], *, fps: int = 20) -> None:
    """Writes frames, uint8 [height, width, 3] each, both sides even, as a video.

    Raises:
        ValueError: there is no frame, or ffmpeg did not write them all.
        OSError: the file can't be written.
    """
    path.touch()  # says better than ffmpeg what is wrong with a path
    written, writer = 0, None
    try:
        for picture in frames:
            if writer is None:
                writer = _start(path, picture, fps)
            writer.send(np.ascontiguousarray(picture))
            written += 1
        if writer is not None:
            writer.close()
        whole = written > 0 and imageio_ffmpeg.count_frames_and_secs(path)[0] == written
    except (OSError, RuntimeError) as error:
        reason = str(error).strip().splitlines()[0]
        raise UserError(f"{path.name}: ffmpeg failed: {reason}") from None
    if written == 0:
        raise UserError(f"{path}: a video needs at least one frame")
    if not whole:
        raise UserError(f"{path.name}: ffmpeg failed: not all {written} frames were written")


def _start(path: Path, picture: NDArray[np.uint8], fps: int):
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
