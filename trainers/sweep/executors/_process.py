"""`emberlink train` in a child process that ends when its parent does.

    python -m emberlink.trainers.sweep.executors._process ARGUMENT...

The standard input is a pipe from the parent, which writes nothing to it. The pipe ends when the
parent has ended, however it ended; the training is then told to save and end.
"""

import os
import runpy
import signal
import sys
import threading

_COMMAND_LINE = "emberlink.trainers.cli"
"""run as a program, not imported: the command line imports the sweep"""


def _end_with_parent() -> None:
    while os.read(0, 1):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    threading.Thread(target=_end_with_parent, daemon=True).start()
    sys.argv[1:1] = ["train"]
    runpy.run_module(_COMMAND_LINE, run_name="__main__", alter_sys=True)
