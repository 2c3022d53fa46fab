"""One training a run folder: a lock that dies with its process."""

import errno
import fcntl
import os
import socket
import stat
from contextlib import suppress
from pathlib import Path

from emberlink.envs.utils.atomic_io import read_bytes
from emberlink.envs.utils.errors import UserError

_FLAGS = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC


class Lock:
    """The right to train in a run folder: an exclusive `flock` on its file `lock`.

    The system gives it up when the process ends, however it ends, so that no number of a process
    that has been given out again can be taken for it. The file holds the process's number and
    machine, for the message.

    Args:
        folder: of the run.

    Raises:
        ValueError: another process has it, or the file cannot be made.
    """

    def __init__(self, folder: Path):
        self.path = folder / "lock"
        self.stale: str | None = None
        """what had locked the folder and is gone, if anything"""
        try:
            self._handle = self._take()
        except BlockingIOError:
            raise UserError(f"{folder}: {self._holder()} is training here") from None
        except OSError as error:
            raise UserError(f"{self.path}: cannot be locked: {error.strerror}") from None

    def release(self) -> None:
        """Takes the file away and gives the lock up; a second time does nothing."""
        if self._handle >= 0:
            with suppress(OSError):  # of a folder that has become read-only, the file stays
                self.path.unlink(missing_ok=True)
            os.close(self._handle)
            self._handle = -1

    def _take(self) -> int:
        while True:
            handle = os.open(self.path, _FLAGS, 0o644)
            try:
                _check_own(handle)
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                # Whoever had it may have taken the file away between the two calls.
                if self.path.exists() and os.path.samestat(os.fstat(handle), self.path.stat()):
                    self.stale = os.pread(handle, 200, 0).decode(errors="replace").strip() or None
                    os.ftruncate(handle, 0)
                    text = f"process {os.getpid()} on {socket.gethostname()}\n"
                    os.pwrite(handle, text.encode(), 0)
                    return handle
            except BaseException:
                os.close(handle)
                raise
            os.close(handle)

    def _holder(self) -> str:
        try:
            text = read_bytes(self.path, 1000).decode(errors="replace").strip()
            return text or "another process"
        except OSError:
            return "another process"


def _check_own(handle: int) -> None:
    """Checks that a lock is a regular file without a second name, which would be changed with it.

    Raises:
        OSError: it is not.
    """
    about = os.fstat(handle)
    if not stat.S_ISREG(about.st_mode) or about.st_nlink > 1:
        raise OSError(errno.EINVAL, "it is no regular file of its own")
