"""Trains one run of a sweep; saves and ends when its parent ends.

    python -P -m emberlink.trainers.sweep.worker RUN [KEY=VALUE ...]

This is `emberlink train resume=RUN KEY=VALUE ...`. The standard input is a pipe to which the parent
writes nothing; it is closed when the parent ends, for whatever reason.
"""

import os
import runpy
import signal
import sys
import threading
from contextlib import suppress
from pathlib import Path

from emberlink.envs.utils.errors import UserError
from emberlink.trainers.runs.lock import Lock


def _end_with_parent() -> None:
    os.read(0, 1)
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with suppress(UserError):  # `train` reports it
        Lock(Path(sys.argv[1]), patience=60).release()  # an earlier process may save and end
    sys.argv[1:2] = ["train", f"resume={sys.argv[1]}"]
    # By name, since importing the command line here would be circular.
    runpy.run_module("emberlink", run_name="__main__", alter_sys=True)
