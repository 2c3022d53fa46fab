"""Leases of runs: at most one process trains a run, also on a network file system.

A lease is a file `logs/leases/RUN.N` in the output folder, where N counts the leases of the run.
Only one of several processes can create a file with this name (a hard link, or O_EXCL), and files
are never removed. The newest file says who holds the run. The holder rewrites it every `BEAT`
seconds. If the file does not change for `PATIENCE` seconds of the observer's own clock, the holder
is regarded as dead, and the next file may be created; a dead process on this machine is noticed at
once. No clocks of different machines are compared, and no locks of the file system are used.
"""

import json
import os
import secrets
import socket
import threading
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Literal

from pydantic.dataclasses import dataclass

from emberlink.envs.utils.atomic_io import inner_folder, link_new, sync, temporary, write_bytes
from emberlink.envs.utils.errors import UserError
from emberlink.envs.utils.validation import STRICT, from_plain
from emberlink.trainers.runs.safe_read import MAX_YAML, parse_json, read_text

FOLDER = ("logs", "leases")
"""folder of the leases, in the output folder"""
BEAT = 10.0
"""seconds between two signs of life of a holder"""
PATIENCE = 60.0
"""seconds without a sign of life after which a holder is regarded as dead"""
Role = Literal["training", "sweep"]
TRAINING: Role = "training"
SWEEP: Role = "sweep"
"""kinds of holders: a training; a sweep that has submitted it"""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class Record:
    """The content of a lease.

    Attributes:
        token: identifies the holder.
        role: `TRAINING` or `SWEEP`.
        host: name of the holder's machine.
        system: identifies the boot and the process namespace of that machine; empty if unknown.
        process: process number of the holder.
        beat: number of signs of life so far.
        ended: how the holder has ended; empty as long as it has not said so.
    """

    token: str
    role: Role
    host: str
    system: str
    process: int
    beat: int = 0
    ended: str = ""

    @property
    def holder(self) -> str:
        """The holder, for messages."""
        return f"process {self.process} on {self.host}"


class Lease:
    """The right to train a run, until `release` or until the holder is regarded as dead.

    Args:
        path: the file of the lease.
        record: its content.
    """

    def __init__(self, path: Path, record: Record):
        self.path, self.record = path, record
        self._beaten = time.monotonic()

    @property
    def run(self) -> str:
        """The name of the run."""
        return self.path.name.rpartition(".")[0]

    def beat(self) -> bool:
        """Writes a sign of life, and returns whether the lease is still held."""
        try:
            if self._is_followed():
                return False
            self._write(replace(self.record, beat=self.record.beat + 1))
            self._beaten = time.monotonic()
        except OSError:  # a file system may be unavailable for a while
            # Before others regard this holder as dead, it regards itself as such.
            return time.monotonic() - self._beaten < PATIENCE / 2
        return True

    def release(self, ended: str) -> None:
        """Gives the right back.

        Args:
            ended: how the holder has ended; not empty.
        """
        with suppress(OSError):  # the lease expires
            if not self._is_followed():
                self._write(replace(self.record, ended=ended))

    def _is_followed(self) -> bool:
        """Returns whether another process has taken the run since."""
        run, _, number = self.path.name.rpartition(".")
        return self.path.with_name(f"{run}.{int(number) + 1}").exists()

    def _write(self, record: Record) -> None:
        write_bytes(self.path, _encode(record), tag=f"-{record.token}")
        self.record = record


class Leases:
    """The leases in an output folder.

    Args:
        output: folder of the run folders; created with its first lease.
    """

    def __init__(self, output: Path):
        self._output = output
        self._newest: dict[str, int] = {}
        self._seen: dict[str, tuple[str, int, float]] = {}

    def take(self, run: str, role: Role, token: str = "") -> Lease | None:
        """Takes the lease of a run, or returns None if it is held.

        Args:
            run: name of the run.
            role: `TRAINING` or `SWEEP`.
            token: a holder that lets this process have its lease.

        Raises:
            UserError: the lease cannot be written.
        """
        found = self.newest(run)
        handed = found is not None and bool(token) and found.token == token
        if found is not None and not handed and self.is_held(run, found):
            return None
        record = Record(
            token=secrets.token_hex(8),
            role=role,
            host=socket.gethostname(),
            system=_system(),
            process=os.getpid(),
        )
        try:
            self._output.mkdir(parents=True, exist_ok=True)
            folder = inner_folder(self._output, *FOLDER)
            path = folder / f"{run}.{self._newest.get(run, 0) + 1}"
            with temporary(path, f"-{record.token}") as partial:
                partial.write_bytes(_encode(record))
                sync(partial)
                link_new(partial, path)
        except FileExistsError:
            return None
        except OSError as error:
            where = error.filename or self._output
            raise UserError(f"{where}: {error.strerror or error}") from None
        return Lease(path, record)

    def take_all(
        self, runs: Iterable[str], role: Role, tokens: dict[str, str] | None = None
    ) -> list[Lease] | None:
        """Takes the leases of several runs, or none of them; arguments are those of `take`."""
        taken: list[Lease] = []
        for run in sorted(runs):
            lease = self.take(run, role, (tokens or {}).get(run, ""))
            if lease is None:
                for other in taken:
                    other.release("another run of the stack is held")
                return None
            taken.append(lease)
        return taken

    def newest(self, run: str) -> Record | None:
        """Returns the newest lease of a run; None if there is none."""
        number = self._newest.get(run, 0)
        # Unlike Path.exists, this is False if the file system is unavailable. `take` then fails.
        while os.path.exists(self._path(run, number + 1)):
            number += 1
        self._newest[run] = number
        return _read(self._path(run, number)) if number else None

    def is_held(self, run: str, record: Record) -> bool:
        """Returns whether the holder of the newest lease of a run is alive, as far as known.

        A holder on another machine is first regarded as alive.
        """
        if record.ended:
            return False
        if record.system and record.system == _system() and not _is_running(record.process):
            return False
        token, beat, since = self._seen.get(run, ("", -1, 0.0))
        if (token, beat) != (record.token, record.beat):
            since = time.monotonic()
            self._seen[run] = record.token, record.beat, since
        return time.monotonic() - since < PATIENCE

    def deaths(self, run: str, token: str) -> int:
        """Returns how many trainings ended without releasing their lease, since that with a token.

        Only the leases that `newest` has found are counted, not one that was taken since.
        """
        count, number = 0, self._newest.get(run, 0)
        while number:
            record = _read(self._path(run, number))
            if record.token == token:
                break
            count += record.role == TRAINING and not record.ended
            number -= 1
        return count

    def since(self, run: str) -> float:
        """Returns the seconds since the newest sign of life, by the clock of the file system."""
        try:
            written = self._path(run, self._newest.get(run, 0)).stat().st_mtime
        except OSError:
            return 0.0
        return max(time.time() - written, 0.0)

    def _path(self, run: str, number: int) -> Path:
        return self._output.joinpath(*FOLDER, f"{run}.{number}")


class Heart(threading.Thread):
    """Writes signs of life for leases in a thread until `close`.

    Args:
        lost: called with a lease that is not held any more.
    """

    def __init__(self, lost: Callable[[Lease], None] = lambda _: None):
        super().__init__(name="emberlink-leases", daemon=True)
        self._lost, self._leases = lost, list[Lease]()
        self._lock, self._closed = threading.Lock(), threading.Event()

    def add(self, leases: Iterable[Lease]) -> None:
        """Adds leases."""
        with self._lock:
            self._leases += leases

    def release(self, leases: Iterable[Lease], ended: str) -> None:
        """Releases leases."""
        with self._lock:
            for lease in leases:
                self._leases = [other for other in self._leases if other is not lease]
                lease.release(ended)

    def run(self) -> None:
        while not self._closed.wait(BEAT):
            with self._lock:
                for lease in list(self._leases):
                    if not lease.beat():
                        self._leases.remove(lease)
                        self._lost(lease)

    def close(self) -> None:
        """Ends the thread; the leases are not released."""
        self._closed.set()


def _encode(record: Record) -> bytes:
    return (json.dumps(asdict(record)) + "\n").encode()


def _read(path: Path) -> Record:
    try:
        text = read_text(path, MAX_YAML)
        if not text:  # a file system without hard links: its holder is about to write it
            return Record(token="", role=SWEEP, host="", system="", process=0)
        return from_plain(Record, parse_json(text))
    except (OSError, ValueError, TypeError) as error:
        raise UserError(f"{path}: not a lease: {error}") from None


def _system() -> str:
    """Returns the boot and process namespace of this machine, or an empty text."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        return f"{boot} {os.readlink('/proc/self/ns/pid')}"
    except OSError:
        return ""


def _is_running(process: int) -> bool:
    try:
        # A zombie has ended. The state follows the name, which is in parentheses.
        status = Path(f"/proc/{process}/stat").read_text()
    except FileNotFoundError:
        return False
    except OSError:
        return True
    return status.rpartition(")")[2].split()[0] not in "ZX"
