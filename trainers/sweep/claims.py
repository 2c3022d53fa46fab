"""Locks the runs of a sweep, so that only one sweep trains a run at a time."""

import fcntl
import hashlib
import os
from collections.abc import Iterable
from pathlib import Path

from emberlink.envs.utils.atomic_io import inner_folder
from emberlink.envs.utils.errors import UserError
from emberlink.trainers.sweep.jobs import Identity

FOLDER = ("logs", "claims")
"""folder of the lock files, in the output folder"""


class Claim:
    """Holds locks on the runs of one job.

    The locks are `flock`s on files in the output folder. A process that inherits `handles` holds
    them, too. They are released when the sweep and that process have ended, for whatever reason.

    Attributes:
        handles: file descriptors of the locked files.
    """

    def __init__(self, handles: list[int]):
        self.handles = handles

    def release(self) -> None:
        """Closes the files. They are not removed, since another sweep may have locked them."""
        for handle in self.handles:
            os.close(handle)
        self.handles = []


def claim(output: Path, identities: Iterable[Identity]) -> Claim | None:
    """Locks runs, or returns None if another sweep has locked one of them.

    Args:
        output: folder of the run folders; it is created if it does not exist.
        identities: identities of the runs.

    Raises:
        UserError: a lock file cannot be created.
    """
    taken = Claim([])
    try:
        output.mkdir(parents=True, exist_ok=True)
        folder = inner_folder(output, *FOLDER)
        for name in sorted(map(_file_name, identities)):
            flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW
            taken.handles.append(os.open(folder / name, flags, 0o644))
            fcntl.flock(taken.handles[-1], fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        taken.release()
        return None
    except OSError as error:
        taken.release()
        raise UserError(f"{error.filename or output}: {error.strerror or error}") from None
    return taken


def _file_name(identity: Identity) -> str:
    return hashlib.sha256(repr(identity).encode()).hexdigest()[:32]
