"""Tests killed and interrupted trainings and full disks, with a few trials of `make soak`."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

COUNTS = {"kill -9": 6, "SIGTERM": 1, "SIGINT": 1, "file size limit": 1}
SOAK = Path(__file__).parents[2] / "soak" / "soak.py"


@pytest.mark.heavy
def test_every_trial_succeeds(tmp_path):
    """Forks in a separate process, which has no threads."""
    done = subprocess.run(
        [sys.executable, str(SOAK), "--counts", json.dumps(COUNTS)],
        capture_output=True,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1", "TMPDIR": str(tmp_path)},
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert all(f"| {name} | " in done.stdout for name in COUNTS)
