"""Fails if the program has become slower, relative to a reference loop in the same process.

    python tests/benchmarks/guard.py            # compare with guard.json; takes some seconds
    python tests/benchmarks/guard.py --record   # after an intended change

A ratio is the time of a unit of our work divided by the time of a loop of plain torch calls. The
loop is of the same kind as the work (many small calls; gathers in large tensors; matrix products),
so that a faster or a busy machine affects both.
"""

import json
import math
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch
from workloads import batch_of, flying, in_turns, make, matrix_product, strong

from emberlink.trainers.config.compose import resolve
from emberlink.trainers.training.setup import TrainingSetup

BASELINE = Path(__file__).with_name("guard.json")
TOLERANCE = 0.30
ROUNDS, ATTEMPTS = 12, 3


def small_calls() -> None:
    """Runs 2000 calls on small tensors."""
    a, b = torch.ones(6, 3), torch.ones(6, 3)
    for _ in range(1000):
        b = (a + b).clamp_(-1, 1)


def gathers() -> Callable[[], object]:
    """Returns a function that gathers from a large tensor and scatters minima into it."""
    index = torch.randint(1_000_000, (150_000,), generator=torch.Generator().manual_seed(0))
    table, new = torch.zeros(1_000_000), torch.ones(150_000)

    def gather() -> None:
        for _ in range(3):
            table.scatter_reduce_(0, index, new, "amin")
            table.take(index).add_(new)

    return gather


def works() -> dict[str, tuple[Callable[[], object], Callable[[], object]]]:
    """Returns name -> (our workload, reference loop)."""
    setup = TrainingSetup(resolve("consensus", ["episodes=1", "env.horizon=200"]))
    batch = batch_of(setup)
    return {
        "one environment": (flying(make(None, 1), 40), small_calls),
        "one environment, consensus": (flying(make("consensus", 1), 20), small_calls),
        "1024 environments": (flying(make(None, 1024), 3), gathers()),
        "1024 environments, consensus": (flying(make("consensus", 1024), 2), gathers()),
        "maps, 8 environments of front, held": (
            flying(strong("maps", 8, "world=front", hold=10), 2),
            gathers(),
        ),
        "maps, 64 UAVs in contact": (
            flying(make("maps", 1, num_uavs=64, **{"env.radio.range": math.inf}), 5),
            gathers(),
        ),
        "update": (lambda: setup.learner.update(batch), matrix_product()),
    }


def ratio(ours: Callable[[], object], beside: Callable[[], object]) -> float:
    """Returns our time over the loop's, each the minimum of several alternating rounds."""
    mine, its = in_turns(ROUNDS, ours, beside, pick=min)
    return mine / its


def check(name: str, before: float, measure: Callable[[], float]) -> bool:
    """Checks whether a workload has kept its speed; a slow result is measured again twice.

    Args:
        name: name of the workload.
        before: recorded ratio.
        measure: function that measures the ratio.
    """
    for _ in range(ATTEMPTS):
        now = measure()
        speed = before / now  # below 1: slower than when it was recorded
        print(f"{name:30} {now:7.3f} loops, recorded {before:7.3f}: speed x {speed:.2f}")
        if speed >= 1 - TOLERANCE:
            return True
    print(f"{name}: has lost more than {TOLERANCE:.0%} of its speed")
    return False


def main() -> int:
    torch.set_num_threads(1)  # other processes may use the second core
    measures = {name: partial(ratio, *pair) for name, pair in works().items()}
    if "--record" in sys.argv:
        recorded = {name: round(measure(), 3) for name, measure in measures.items()}
        BASELINE.write_text(json.dumps(recorded, indent=1) + "\n")
        return 0
    recorded = json.loads(BASELINE.read_text())
    kept = [check(name, recorded[name], measure) for name, measure in measures.items()]
    return int(not all(kept))


if __name__ == "__main__":
    sys.exit(main())
