"""The right to train a run of a sweep, held by one sweep and its processes at a time."""

import fcntl
import hashlib
import os
from collections.abc import Iterable
from pathlib import Path

from emberlink.envs.utils.atomic_io import inner_folder
from emberlink.envs.utils.errors import UserError
from emberlink.trainers.sweep.jobs import Identity

FOLDER = ("logs", "claims")
"""where the lock files are, in the output folder"""


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


def claim(output: Path, identities: Iterable[Identity]) -> Claim | None:
    """Locks runs, or returns None where another sweep has one of them.

    Args:
        output: the folder of the run folders; it is made if it is not there.
        identities: of the runs.

    Raises:
        UserError: a lock file cannot be made.
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
        raise UserError(f"output={output}: {error.strerror or error}") from None
    return taken


def _file_name(identity: Identity) -> str:
    return hashlib.sha256(repr(identity).encode()).hexdigest()[:32]
