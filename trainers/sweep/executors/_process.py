"""Runs `emberlink train` in a child process that ends with its parent.

    python -m emberlink.trainers.sweep.executors._process ARGUMENT...

The standard input is a pipe from the parent, which writes nothing to it. When the parent ends, for
whatever reason, the pipe is closed, and this process sends itself SIGTERM: the training saves.
"""

import os
import runpy
import signal
import sys
import threading

_COMMAND_LINE = "emberlink.trainers.cli"
"""run by `runpy`, since importing it would be circular"""


def _end_with_parent() -> None:
    while os.read(0, 1):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    threading.Thread(target=_end_with_parent, daemon=True).start()
    sys.argv[1:1] = ["train"]
    runpy.run_module(_COMMAND_LINE, run_name="__main__", alter_sys=True)
