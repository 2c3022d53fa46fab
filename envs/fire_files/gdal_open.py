"""Opening rasters with GDAL: what it complains of is an error here, and never reaches the user."""

import logging
import os
import re
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from emberlink.envs.utils.errors import UserError

from .projection import first_line, library

_CACHE = 100_000_000  # bytes that GDAL keeps of what it decoded; its default is 5 % of the memory
_ALONE = threading.Lock()  # of two threads, one would put back the other's standard error
_DAMAGE = re.compile(r"IO error|tag ignored|TIFFVSetField|(Null|Incorrect) count|_tiff\w+Proc:")
_OF_LIBTIFF = re.compile(rb"_tiff\w+Proc:|TIFF\w+:")


@contextmanager
def opened(path: Path, driver: str = "GTiff") -> Iterator[Any]:
    """A raster, open for reading with rasterio.

    Args:
        path: a file on this machine.
        driver: GDAL's name of its format.

    Raises:
        ValueError: one line: it is damaged, also where GDAL would go on with a part of it lost.
    """
    rasterio = library("rasterio", "GeoTIFF" if driver == "GTiff" else f"{path.suffix} rasters")
    heard: list[str] = []
    try:
        with (
            _overheard(heard),
            rasterio.Env(GDAL_CACHEMAX=_CACHE),
            rasterio.open(path, driver=driver) as dataset,
        ):
            yield dataset
    except (rasterio.errors.RasterioError, OSError) as error:
        raise UserError(f"{first_line(error)}; expected a whole raster") from None
    if heard:
        raise UserError(f"damaged: {heard[0][:200]}; expected a whole raster")


@contextmanager
def _overheard(heard: list[str]) -> Iterator[None]:
    """Collects GDAL's complaints of damage: of its log, and of what is printed past Python."""
    logger, listener = logging.getLogger("rasterio._env"), _Listener(heard)
    hooks = sys.excepthook, sys.unraisablehook

    def printed(kind: type[BaseException], error: BaseException, trace: Any) -> None:
        if not issubclass(kind, UnicodeDecodeError):  # `unraisable` is called for it too
            hooks[0](kind, error, trace)

    def unraisable(about: Any) -> None:
        if "rasterio" in str(about.object):  # it cannot decode GDAL's message
            heard.append("GDAL's message about it is no text")
        else:
            hooks[1](about)

    with _ALONE, _standard_error(heard):
        before = logger.level, logger.propagate
        logger.setLevel(logging.WARNING)
        logger.propagate = False
        logger.addHandler(listener)
        sys.excepthook, sys.unraisablehook = printed, unraisable
        try:
            yield
        finally:
            sys.excepthook, sys.unraisablehook = hooks
            logger.removeHandler(listener)
            logger.setLevel(before[0])
            logger.propagate = before[1]


class _Listener(logging.Handler):
    def __init__(self, heard: list[str]):
        super().__init__()
        self._heard = heard

    def emit(self, record: logging.LogRecord) -> None:
        message = record.getMessage()
        if record.levelno >= logging.ERROR or _DAMAGE.search(message):
            self._heard.append(message)


@contextmanager
def _standard_error(heard: list[str]) -> Iterator[None]:
    """Takes what libtiff prints on file descriptor 2; what others print is printed afterwards."""
    try:
        kept = os.dup(2)
    except OSError:  # it is closed
        yield
        return
    with tempfile.TemporaryFile() as taken:
        os.dup2(taken.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            taken.seek(0)
            for line in taken.read().splitlines(keepends=True):
                if _OF_LIBTIFF.match(line):
                    heard.append(line.decode("utf-8", "replace").strip())
                else:
                    os.write(2, line)
