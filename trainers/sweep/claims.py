"""The right to train a run of a sweep, held by one sweep and its processes at a time."""

import fcntl
import hashlib
import os
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from emberlink.envs.utils.errors import UserError

from .jobs import Identity

FOLDER = "claims"
"""the folder of the lock files, beside the logs of the sweep"""


class Claim:
    """Locks on the runs of one job.

    The locks are `flock`s on files of the output folder. A process that inherits `handles` holds
    them too: they are free once the sweep and that process have ended, however they ended.

    Attributes:
        handles: file descriptors of the locked files.
    """

    def __init__(self, handles: list[int]):
        self.handles = handles

    def release(self) -> None:
        """Closes the files. The lock files stay: removing them could free another's lock."""
        for handle in self.handles:
            os.close(handle)
        self.handles = []


def claim(logs: Path, identities: Iterable[Identity]) -> Claim | None:
    """Locks runs, or returns None where another sweep has one of them.

    Args:
        logs: the folder of the sweep's logs.
        identities: of the runs.

    Raises:
        UserError: a lock file cannot be made.
    """
    folder = logs / FOLDER
    taken = Claim([])
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name in sorted(map(_file_name, identities)):
            flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW
            taken.handles.append(os.open(folder / name, flags, 0o644))
            fcntl.flock(taken.handles[-1], fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        taken.release()
        return None
    except OSError as error:
        with suppress(OSError):
            taken.release()
        raise UserError(f"{folder}: a run cannot be claimed: {error.strerror or error}") from None
    return taken


def _file_name(identity: Identity) -> str:
    return hashlib.sha256(repr(identity).encode()).hexdigest()[:32]
