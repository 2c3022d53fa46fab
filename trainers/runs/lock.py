"""Locks a folder, so that only one process trains or sweeps in it."""

import errno
import os
import socket
from contextlib import suppress
from pathlib import Path

from filelock import FileLock, Timeout

from emberlink.envs.utils.atomic_io import check_regular, read_bytes
from emberlink.envs.utils.errors import UserError

_NO_LOCKS = {errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP}
_MAX_HOLDER = 1000
"""bytes of a lock file that are read"""


class LockedError(UserError):
    """Reports that another process holds a lock."""


class Lock:
    """Holds an exclusive lock on the file `lock` of a folder until `release`.

    The operating system releases the lock when the process ends, also after SIGKILL. The file holds
    the process number and the host name, for error messages.

    Args:
        folder: the folder.
        doing: what processes do in it, for error messages.

    Raises:
        LockedError: another process holds the lock.
        UserError: `lock` is a link or not a regular file, or the file system has no locks.
    """

    def __init__(self, folder: Path, doing: str = "training"):
        self.path = folder / "lock"
        # No fallback to a lock without the operating system: its file would outlive the process.
        self._lock = FileLock(
            self.path,
            timeout=0,
            thread_local=False,
            fallback_to_soft=False,
            on_acquired=self._write_holder,
        )
        try:
            folder.stat()  # an error if it is missing: FileLock would create it
            self._lock.acquire()
        except Timeout:
            raise LockedError(f"{folder}: {self._holder()} is {doing} here") from None
        except OSError as error:
            raise UserError(f"{self.path}: cannot be locked: {_reason(error)}") from None

    def release(self) -> None:
        """Removes the file and releases the lock; further calls do nothing."""
        if self._lock.is_locked:
            with suppress(OSError):  # the folder may have become read-only
                self.path.unlink(missing_ok=True)
            self._lock.release()

    def _write_holder(self, handle: int) -> None:
        """Writes the process number and host name to the locked file.

        Raises:
            OSError: it is not a regular file, or is a hard link.
        """
        check_regular(handle, self.path)
        if os.fstat(handle).st_nlink > 1:
            raise OSError(errno.EMLINK, "it is a hard link", str(self.path))
        os.ftruncate(handle, 0)
        os.pwrite(handle, f"process {os.getpid()} on {socket.gethostname()}\n".encode(), 0)

    def _holder(self) -> str:
        try:
            text = read_bytes(self.path, _MAX_HOLDER).decode(errors="replace").strip()
        except OSError:
            text = ""
        return text or "another process"


def _reason(error: OSError) -> str:
    text = error.strerror or str(error)
    if error.errno in _NO_LOCKS:
        text += "; the file system has no locks, choose another one with output=FOLDER"
    return text
