"""Counts rollbacks to a checkpoint after a NaN or Inf, and reduces the learning rates."""

from typing import Annotated

from pydantic import Field
from pydantic.dataclasses import dataclass

from emberlink.envs.utils.validation import STRICT, CountOrZero
from emberlink.trainers.training.non_finite import NonFiniteError

FACTOR = 0.5
"""factor of the learning rates at each rollback"""
MAX_ROLLBACKS = 5
"""maximum rollbacks without progress"""
FILE = "rollbacks.jsonl"
"""file with a line for each rollback; unlike metrics.jsonl, it is never truncated"""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class Rollbacks:
    """The rollbacks of a run so far."""

    lr_scale: Annotated[float, Field(gt=0, le=1)] = 1.0
    """factor of the configuration's learning rates"""
    count: Annotated[int, Field(ge=0, le=MAX_ROLLBACKS)] = 0
    """rollbacks since training last passed `worst_step`"""
    worst_step: CountOrZero = 0
    """latest step at which training failed"""

    def passed(self, step: int) -> "Rollbacks":
        """Returns the rollbacks after a step was saved; past `worst_step`, the count is 0 again."""
        if step <= self.worst_step:
            return self
        return Rollbacks(lr_scale=self.lr_scale, worst_step=self.worst_step)

    def after(self, error: NonFiniteError) -> "Rollbacks":
        """Returns the rollbacks with one more.

        Raises:
            NonFiniteError: there are `MAX_ROLLBACKS` already.
        """
        if self.count == MAX_ROLLBACKS:
            raise NonFiniteError(
                f"{error}; given up after {MAX_ROLLBACKS} rollbacks, learning rates x "
                f"{self.lr_scale:g}",
                error.report,
                error.dump,
            )
        return Rollbacks(
            lr_scale=self.lr_scale * FACTOR,
            count=self.count + 1,
            worst_step=max(error.report.step, self.worst_step),
        )
