"""Locks a run folder, so that only one process trains in it."""

import os
import socket
from contextlib import suppress
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from emberlink.envs.utils.errors import UserError


class LockedError(UserError):
    """Reports that another process holds a lock."""


class Lock:
    """Holds an exclusive lock on the file `lock` of a run folder until `release`.

    The operating system releases the lock when the process ends, also after SIGKILL. A LockedError
    if another process holds it for more than `patience` seconds.
    """

    def __init__(self, folder: Path, patience: float = 0):
        self.path = folder / "lock"
        # No fallback to a lock without the operating system: its file would outlive the process.
        how: Any = {"thread_local": False, "fallback_to_soft": False}
        self._lock = FileLock(self.path, timeout=patience, **how)
        try:
            folder.stat()  # an error if it is missing: FileLock would create it
            self._lock.acquire()
            self.path.write_text(f"process {os.getpid()} on {socket.gethostname()}\n")
        except Timeout:
            holder = self.path.read_text().strip() if self.path.exists() else "another process"
            raise LockedError(f"{folder}: {holder} is training here") from None
        except OSError as error:
            why = f"{error.strerror or error}; output=FOLDER chooses another place"
            raise UserError(f"{self.path}: cannot be locked: {why}") from None

    def release(self) -> None:
        """Removes the file and releases the lock; further calls do nothing."""
        if self._lock.is_locked:
            with suppress(OSError):  # the folder may have become read-only
                self.path.unlink(missing_ok=True)
            self._lock.release()
