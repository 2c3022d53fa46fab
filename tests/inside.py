"""An executor of sweeps for tests."""

from emberlink.trainers.cli.main import main
from emberlink.trainers.sweep.executors.base import Executor, Task


class Inside(Executor):
    """Runs each training in this process, since a new process takes seconds to start."""

    def __init__(self) -> None: ...

    def slots(self, tasks: int) -> int:
        return 1

    def submit(self, task: Task) -> int:
        return main(["train", *task.arguments])

    def poll(self, handle: int) -> int:
        return handle

    def cancel(self, handle: int) -> None: ...
