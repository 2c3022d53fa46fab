"""Stops trainings in all known ways, many times, and prints a table.

python tests/soak/soak.py            # about half an hour
python tests/soak/soak.py --small    # a tenth of it
"""

import argparse
import json
import os
import random
import signal
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")

from children import kill_trials
from ends import full_disk_trial, signal_trial

Result = tuple[int, list[str]]


def trials(folder: Path, counts: dict[str, int], seed: int) -> dict[str, tuple[Callable, int]]:
    """Returns, for each kind of trial, a function that runs a number of trials."""
    draw = random.Random(seed)

    def repeated(trial: Callable[[Path], list[str]]) -> Callable[[int], Result]:
        def many(count: int) -> Result:
            results = [trial(folder / f"trial_{number}") for number in range(count)]
            return count, [failure for result in results for failure in result]

        return many

    every = {
        "kill -9": lambda count: kill_trials(folder, count, seed),
        "SIGTERM": repeated(lambda here: signal_trial(signal.SIGTERM, here, draw)),
        "SIGINT": repeated(lambda here: signal_trial(signal.SIGINT, here, draw)),
        "file size limit": repeated(lambda here: full_disk_trial(here, draw)),
        "full file system": repeated(lambda here: full_disk_trial(here, draw, mount=True)),
    }
    return {name: (every[name], count) for name, count in counts.items() if count}


def run(folder: Path, counts: dict[str, int], seed: int = 0) -> dict[str, tuple[int, list[str]]]:
    """Runs all trials; returns the number and the failures of each kind."""
    results = {}
    for name, (many, count) in trials(folder, counts, seed).items():
        began = time.monotonic()
        done, failures = many(count)
        results[name] = done, failures
        print(f"| {name} | {done} | {len(failures)} | {time.monotonic() - began:.0f} |", flush=True)
        for failure in failures[:5]:
            print("   ", failure[:1000], flush=True)
    return results


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--small", action="store_true", help="a tenth of the trials")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--counts", type=json.loads, help="of each kind, as JSON")
    options = parser.parse_args()
    share = 10 if options.small else 1
    counts = options.counts or {
        "kill -9": 200 // share,
        "SIGTERM": 50 // share,
        "SIGINT": 50 // share,
        "file size limit": 50 // share,
        "full file system": 20 // share if os.geteuid() == 0 else 0,
    }
    print("| trial | how many | failures | seconds |\n|---|---|---|---|", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        results = run(Path(folder), counts, options.seed)
    return int(any(failures for _, failures in results.values()))


if __name__ == "__main__":
    raise SystemExit(main())
