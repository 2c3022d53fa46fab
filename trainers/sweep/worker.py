"""Runs one task of a sweep: `emberlink train`, while it holds the leases of its runs.

    python -m emberlink.trainers.sweep.worker TASK ARGUMENT...

TASK is JSON: {"output": FOLDER, "leases": {RUN: TOKEN}, "restarts": N}. The arguments are those of
`emberlink train`. The standard input is a pipe from the parent, which writes nothing to it. When
the parent ends, for whatever reason, the pipe is closed, and this process sends itself SIGTERM: the
training saves. If the parent writes a byte first, the training goes on.

The exit status is that of the training, or one of `HELD` and `DIED_TOO_OFTEN`.
"""

import json
import os
import runpy
import signal
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

from emberlink.envs.utils.errors import UserError
from emberlink.trainers.runs.lock import Lock, LockedError
from emberlink.trainers.sweep import leases

HELD = 75
"""exit status if another process trains the run (EX_TEMPFAIL)"""
DIED_TOO_OFTEN = 76
"""exit status if the run has been started too often without coming to an end"""
_COMMAND_LINE = "emberlink.trainers.cli"
"""run by `runpy`, since importing it would be circular"""
_INTERVAL = 1.0


def _end_with_parent() -> None:
    if not os.read(0, 1):
        os.kill(os.getpid(), signal.SIGTERM)


def _exit(number: int, _: Any) -> NoReturn:
    """Ends the process before the training handles signals itself."""
    raise SystemExit(128 + number)


def _take(task: dict[str, Any]) -> list[leases.Lease] | int:
    """Waits for the leases of the runs and takes them; returns an exit status if it cannot."""
    folder, tokens = leases.Leases(Path(task["output"])), task["leases"]
    began, taken = time.monotonic(), None
    while taken is None:
        taken = folder.take_all(tokens, leases.TRAINING, tokens)
        if taken is None:
            if time.monotonic() - began > 1.5 * leases.PATIENCE:
                print("another process is training this run")
                return HELD
            time.sleep(_INTERVAL)
    deaths = max(folder.deaths(run, token) for run, token in tokens.items())
    if deaths <= task["restarts"]:
        return taken
    for lease in taken:
        lease.release("not started")
    print(f"not started again: {deaths} trainings of this run ended without saving")
    return DIED_TOO_OFTEN


def _wait_for_folders(arguments: Sequence[str]) -> bool:
    """Waits for the locks of the run folders, and returns whether they are free.

    A process that was suspended until it lost its lease holds them until it wakes up and ends.
    """
    from emberlink.trainers.training.folders import find_runs  # imports torch

    folder = Path(arguments[0].removeprefix("resume="))
    if not folder.is_dir():
        return True  # the training reports it
    began = time.monotonic()
    while True:
        try:
            for run in find_runs(folder):
                Lock(run.path).release()
            return True
        except LockedError as error:
            if time.monotonic() - began > 1.5 * leases.PATIENCE:
                print(error)
                return False
            time.sleep(_INTERVAL)
        except UserError:
            return True


def _lost(lease: leases.Lease) -> NoReturn:
    """Ends the process at once: another one may already train the run."""
    print(
        f"{lease.path}: the lease was lost, the training ends at once", file=sys.stderr, flush=True
    )
    os.kill(os.getpid(), signal.SIGKILL)
    raise AssertionError


def main() -> int:
    """Takes the leases, trains, releases the leases, and returns the exit status."""
    for number in (signal.SIGTERM, signal.SIGUSR1, signal.SIGUSR2):
        signal.signal(number, _exit)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    taken = _take(json.loads(sys.argv.pop(1)))
    if isinstance(taken, int):
        return taken
    heart = leases.Heart(_lost)
    heart.add(taken)
    heart.start()
    status = 1
    try:
        if not _wait_for_folders(sys.argv[1:]):
            status = HELD
            return status
        sys.argv[1:1] = ["train"]
        runpy.run_module(_COMMAND_LINE, run_name="__main__", alter_sys=True)
        status = 0
    except SystemExit as ended:
        status = ended.code if isinstance(ended.code, int) else int(ended.code is not None)
    finally:
        heart.release(taken, f"exit status {status}")
    return status


if __name__ == "__main__":
    sys.exit(main())
