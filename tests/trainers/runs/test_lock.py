"""Tests that a run folder is locked by at most one training."""

import errno
import fcntl
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from refusal import refused
from test_resume import REPLAY, begun, until

from emberlink.trainers.runs.lock import Lock
from emberlink.trainers.training.resume import resume

HOLD = """
import sys, time
from pathlib import Path
from emberlink.trainers.runs.lock import Lock
lock = Lock(Path(sys.argv[1]))
print("locked", flush=True)
time.sleep(60)
"""


@pytest.fixture
def other(tmp_path):
    """Starts another process that locks a folder."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path)],
        stdout=subprocess.PIPE,
        text=True,
        cwd=Path(__file__).parents[3],
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "locked\n"
    yield process
    process.kill()
    process.wait()


def test_the_second_process_is_refused_until_the_first_is_dead(other, tmp_path):
    with pytest.raises(ValueError, match=f"process {other.pid} on {socket.gethostname()}"):
        Lock(tmp_path)
    other.send_signal(signal.SIGKILL)
    other.wait()
    assert (tmp_path / "lock").exists()
    lock = Lock(tmp_path)
    assert str(os.getpid()) in (tmp_path / "lock").read_text()
    lock.release()
    lock.release()
    assert not (tmp_path / "lock").exists()


def test_a_file_system_without_locks(tmp_path, monkeypatch):
    def flock(handle: int, how: int) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", flock)
    with pytest.raises(ValueError, match=r"lock: cannot be locked: .*output=FOLDER"):
        Lock(tmp_path)
    with pytest.raises(ValueError, match="lock: cannot be locked"):
        Lock(tmp_path / "missing")


def test_two_trainings_in_one_folder(tmp_path, capsys):
    run = until(begun("independent", tmp_path, *REPLAY), 10).run
    assert not list(tmp_path.rglob("lock"))
    first = resume(run.path)
    try:
        before = {path: path.read_bytes() for path in run.path.rglob("*") if path.is_file()}
        refused(["train", f"resume={run.path}"], capsys, f"process {os.getpid()}")
        assert before == {p: p.read_bytes() for p in run.path.rglob("*") if p.is_file()}
    finally:
        first.close()
    resume(run.path).close()
