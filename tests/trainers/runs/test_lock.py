"""Tests that a run folder is locked by at most one training."""

import os

from refusal import refused
from test_resume import REPLAY, begun, until

from emberlink.trainers.training.resume import resume


def test_two_trainings_in_one_folder(tmp_path, capsys):
    run = until(begun("independent", tmp_path, *REPLAY), 10).run
    assert not list(tmp_path.rglob("lock"))
    first = resume(run.path)
    held = (run.path / "lock").read_text()
    try:
        before = {path: path.read_bytes() for path in run.path.rglob("*") if path.is_file()}
        refused(["train", f"resume={run.path}"], capsys, f"process {os.getpid()} on ")
        assert before == {p: p.read_bytes() for p in run.path.rglob("*") if p.is_file()}
    finally:
        first.close()
    (run.path / "lock").write_text(held)  # left by a process that was killed
    resume(run.path).close()
    assert not (run.path / "lock").exists()
