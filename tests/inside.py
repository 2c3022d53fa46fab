"""An executor of sweeps for tests."""

from collections.abc import Sequence

from emberlink.trainers.cli.main import main
from emberlink.trainers.sweep.executors.base import Executor, Task


class Inside(Executor):
    """Runs each training in this process, since a new process takes seconds to start."""

    workers = 1

    def __init__(self) -> None: ...

    def submit(self, tasks: Sequence[Task]) -> list[int]:
        return [main(["train", f"resume={task.run}", *task.overrides]) for task in tasks]

    def poll(self, handle: int) -> int:
        return handle

    def cancel(self, handle: int) -> None: ...
