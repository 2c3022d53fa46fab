"""Asks what to do with running trainings after Ctrl-C."""

import sys

from emberlink.trainers.sweep.progress import SweepProgress

STOP, LEAVE, CONTINUE = "s", "l", "c"
"""answers: save and stop the trainings, leave them running, go on with the sweep"""


def ask(progress: SweepProgress, running: int, may_leave: bool) -> str:
    """Returns the user's answer; `STOP` without a terminal.

    Args:
        progress: is hidden during the question.
        running: number of running trainings.
        may_leave: whether `LEAVE` is one of the answers.
    """
    if sys.stdin is None or not sys.stdin.isatty() or not progress.console.is_terminal:
        return STOP
    progress.stop()
    answer = ""
    choices = {STOP: "[s]top and save them", LEAVE: "[l]eave them running", CONTINUE: "[c]ontinue"}
    if not may_leave:
        del choices[LEAVE]
    *first, last = choices.values()
    while answer not in choices:
        progress.console.print(
            f"{running} trainings are running or queued: {', '.join(first)}, or {last}? ",
            end="",
            markup=False,
            highlight=False,
        )
        line = sys.stdin.readline()
        answer = line.strip().lower()[:1] if line else STOP
    if answer == CONTINUE:
        progress.start()
    return answer
