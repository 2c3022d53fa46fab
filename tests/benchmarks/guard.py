"""Fails when the program has become slower, measured against a loop that is run beside it.

    python tests/benchmarks/guard.py            # compare with guard.json; some seconds
    python tests/benchmarks/guard.py --record   # after a change that is meant

A ratio says how many times a loop of plain torch calls fits into one unit of our work. The loop is
of the same kind as the work (many small calls; gathers in large tensors; matrix products), so that
a faster or a busy machine speeds up or slows down both.
"""

import json
import sys
from collections.abc import Callable
from pathlib import Path

import torch
from workloads import batch_of, flying, in_turns, make, matrix_product

from emberlink.trainers.config import resolve
from emberlink.trainers.loop import Trainer

BASELINE = Path(__file__).with_name("guard.json")
TOLERANCE = 0.30
ROUNDS = 12


def small_calls() -> None:
    """2000 calls on a few numbers each."""
    a, b = torch.ones(6, 3), torch.ones(6, 3)
    for _ in range(1000):
        b = (a + b).clamp_(-1, 1)


def gathers() -> Callable[[], object]:
    """Gathers from and minima into a large tensor."""
    index = torch.randint(1_000_000, (150_000,), generator=torch.Generator().manual_seed(0))
    table, new = torch.zeros(1_000_000), torch.ones(150_000)

    def gather() -> None:
        for _ in range(3):
            table.scatter_reduce_(0, index, new, "amin")
            table.take(index).add_(new)

    return gather


def works() -> dict[str, tuple[Callable[[], object], Callable[[], object]]]:
    """Name -> (our work, the loop beside it)."""
    learner = Trainer(resolve("consensus", ["episodes=1", "env.horizon=200"]))
    batch = batch_of(learner)
    return {
        "one environment": (flying(make(None, 1), 40), small_calls),
        "one environment, consensus": (flying(make("consensus", 1), 20), small_calls),
        "1024 environments": (flying(make(None, 1024), 3), gathers()),
        "1024 environments, consensus": (flying(make("consensus", 1024), 2), gathers()),
        "update": (lambda: learner.learner.update(batch), matrix_product()),
    }


def ratios() -> dict[str, float]:
    """Our time over the loop's: of each the shortest of several rounds, taken in turns."""
    found = {}
    for name, pair in works().items():
        ours, beside = in_turns(ROUNDS, *pair, pick=min)
        found[name] = ours / beside
    return found


def main() -> int:
    now = ratios()
    if "--record" in sys.argv:
        BASELINE.write_text(json.dumps({k: round(v, 3) for k, v in now.items()}, indent=1) + "\n")
        return 0
    slower = 0
    for name, before in json.loads(BASELINE.read_text()).items():
        speed = before / now[name]  # below 1: slower than when it was recorded
        slower += speed < 1 - TOLERANCE
        print(f"{name:30} {now[name]:7.3f} loops, recorded {before:7.3f}: speed x {speed:.2f}")
    if slower:
        print(f"{slower} of {len(now)} have lost more than {TOLERANCE:.0%} of their speed")
    return int(slower > 0)


if __name__ == "__main__":
    sys.exit(main())
