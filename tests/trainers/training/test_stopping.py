"""Tests killed and interrupted trainings and full disks, with a few trials of `make soak`."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

COUNTS = {"kill -9": 6, "SIGTERM": 1, "SIGINT": 1, "file size limit": 1}
SOAK = Path(__file__).parents[2] / "soak" / "soak.py"


@pytest.fixture(scope="module")
def table(tmp_path_factory) -> dict[str, list[str]]:
    """Returns the printed table, by kind of trial, of a separate process without threads."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    result = subprocess.run(
        [sys.executable, str(SOAK), "--counts", json.dumps(COUNTS)],
        capture_output=True,
        text=True,
        env={**environment, "TMPDIR": str(tmp_path_factory.mktemp("soak"))},
    )
    assert "Traceback" not in result.stdout, result.stdout
    rows = [line.strip("| ").split(" | ") for line in result.stdout.splitlines()]
    results = {row[0]: row for row in rows if len(row) == 4}
    assert results.keys() >= COUNTS.keys(), result.stdout + result.stderr
    results["all"] = [result.stdout]
    return results


@pytest.mark.heavy
@pytest.mark.parametrize("kind", COUNTS)
def test_every_trial_succeeds(kind, table):
    _, done, failures, _ = table[kind]
    assert int(done) == COUNTS[kind]
    assert failures == "0", table["all"][0]
