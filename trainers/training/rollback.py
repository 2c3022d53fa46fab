"""Going back to the last checkpoint with smaller learning rates, where a number is not finite."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from emberlink.trainers.runs import checkpoint_file

from . import state
from .divergence import Divergence

if TYPE_CHECKING:
    from .trainer import Trainer

FACTOR = 0.5
"""by which both learning rates are multiplied at each rollback"""
TRIES = 5
"""rollbacks from steps that no checkpoint lies beyond, before it is given up"""
FILE = "rollbacks.jsonl"
"""has a line for each; unlike metrics.jsonl, it is never cut"""


def roll_back(trainer: "Trainer", found: Divergence, files: Sequence[str]) -> str:
    """Puts a training where its last checkpoint was made, or at the beginning.

    A checkpoint with the smaller rates is made there at once, so that a run that is stopped now
    goes on with them.

    Args:
        trainer: of which nothing later than the checkpoint is kept but its best networks.
        found: why.
        files: of each run folder, that have a line for each episode.

    Returns:
        What the user is to be told.

    Raises:
        Divergence: `on_nan` is not rollback, or this has been tried often enough.
        ValueError: a file cannot be read or written.
    """
    if trainer.config.on_nan != "rollback":
        raise found
    rate, tries, bad = trainer.rate * FACTOR, trainer.tries + 1, found.culprit.step
    if tries > TRIES:
        text = f"{found}; given up after {TRIES} rollbacks, learning rates x {trainer.rate:g}"
        raise Divergence(text, found.culprit, found.bundle)
    furthest = max(bad, trainer.furthest)
    seconds, best = trainer.elapsed(), trainer.best
    states = trainer.run.states()
    sizes = [dict[str, int]() for _ in trainer.runs]
    trainer.collector.shutdown()
    trainer.build()
    if states:
        header, content = checkpoint_file.read(states[-1])
        assert header is not None, "a state has a header"
        state.restore(trainer, states[-1], header, content)
        sizes = header["files"]
    trainer.rate, trainer.tries, trainer.furthest = rate, tries, furthest
    trainer.seconds, trainer.best = seconds, best
    trainer.learner.slow_down(rate)
    line = {
        "step": bad,
        "to": trainer.step,
        "rate": rate,
        "culprit": str(found.culprit),
        "bundle": found.bundle.name if found.bundle else None,
    }
    for run, of in zip(trainer.runs, sizes, strict=True):
        for file in files:
            run.cut(file, of.get(file, 0))
        run.take_away_after(trainer.step)
        run.append(FILE, line)
    trainer.save()
    where = f"on from step {trainer.step} with learning rates x {rate:g}"
    return f"{found}; rollback {tries} of {TRIES}: {where}"
