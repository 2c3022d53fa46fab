"""Trainings that are killed, interrupted, or run out of room: a few of what `make soak` does."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

COUNTS = {"kill -9": 12, "SIGTERM": 3, "SIGINT": 3, "file size limit": 3}
SOAK = Path(__file__).parent / "soak" / "soak.py"


@pytest.fixture(scope="module")
def table(tmp_path_factory) -> dict[str, list[str]]:
    """What the program prints, by kind of trial.

    In a process of its own: it forks, and this one may have threads.
    """
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    result = subprocess.run(
        [sys.executable, str(SOAK), "--counts", json.dumps(COUNTS)],
        capture_output=True,
        text=True,
        env={**environment, "TMPDIR": str(tmp_path_factory.mktemp("soak"))},
    )
    assert "Traceback" not in result.stdout, result.stdout
    rows = [line.strip("| ").split(" | ") for line in result.stdout.splitlines()]
    found = {row[0]: row for row in rows if len(row) == 4}
    assert found.keys() >= COUNTS.keys(), result.stdout + result.stderr
    found["all"] = [result.stdout]
    return found


@pytest.mark.slow
@pytest.mark.parametrize("kind", COUNTS)
def test_every_one_goes_on(kind, table):
    _, done, failures, _ = table[kind]
    assert int(done) == COUNTS[kind]
    assert failures == "0", table["all"][0]
