"""Tests the manifest of a sweep, and `emberlink sweep status`, which reads it."""

import json
import os
import time
from dataclasses import replace

import pytest
from rich.console import Console

from emberlink.trainers.cli.main import main
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.runs.run_folder import RunFolder
from emberlink.trainers.sweep import manifest
from emberlink.trainers.sweep.jobs import folder_name, hash_of, identity, jobs_of
from emberlink.trainers.sweep.leases import SWEEP, TRAINING, Leases
from emberlink.trainers.sweep.manifest import Manifest, Row

KEYS = ["independent", "episodes=4", "evaluation.interval=0"]


def jobs(folder, *more):
    return jobs_of([*KEYS, f"output={folder}", *more])


def test_a_row_names_the_configuration_and_its_folder(tmp_path):
    (job,) = jobs(tmp_path, "seed=3")
    Manifest(tmp_path, "local").load([job])
    (row,) = manifest.read(tmp_path).values()
    config = job.configs[0]
    name = "independent, paper, paper, seed 3"
    assert row == Row(
        run=hash_of(identity(config)),
        name=name,
        folder=folder_name(config),
        state="new",
        episodes=4,
    )
    assert row.folder == f"independent_paper_paper_s3_{row.run[:8]}"


def test_the_hash_does_not_depend_on_where_the_run_is_trained():
    def hash_with(*more):
        return hash_of(identity(resolve("independent", more)))

    assert hash_with() == hash_with("output=elsewhere", "logger=csv", "checkpoint_interval=3")
    assert hash_with() != hash_with("seed=1")
    assert hash_with() != hash_with("learner.batch_size=8")


def test_the_rows_of_other_sweeps_are_kept(tmp_path):
    first, second = Manifest(tmp_path, "local"), Manifest(tmp_path, "ray")
    ((a,), (b,)) = jobs(tmp_path, "seed=0"), jobs(tmp_path, "seed=1")
    first.load([a])
    second.load([b])
    second.set(b, "queued", task="7", executor="ray")
    first.set(a, "running")
    assert [row.state for row in manifest.read(tmp_path).values()] == ["running", "queued"]
    again = Manifest(tmp_path, "ray")
    again.load([a, b])
    assert (again.task(a), again.task(b)) == ("", "7")
    other = Manifest(tmp_path, "local")
    other.load([a, b])
    assert other.task(b) == ""


def test_the_file_is_replaced_and_a_link_is_not_followed(tmp_path):
    outside = tmp_path / "outside"
    outside.write_text("kept")
    (tmp_path / "runs").mkdir()
    Manifest(tmp_path / "runs").load([])
    before = (tmp_path / "runs" / manifest.FILE).stat().st_ino
    Manifest(tmp_path / "runs").load([])
    assert (tmp_path / "runs" / manifest.FILE).stat().st_ino != before
    (tmp_path / "runs" / manifest.FILE).unlink()
    (tmp_path / "runs" / manifest.FILE).symlink_to(outside)
    with pytest.raises(ValueError, match="not a manifest"):
        Manifest(tmp_path / "runs").load([])
    assert outside.read_text() == "kept"
    assert [path.name for path in (tmp_path / "runs").iterdir()] == [manifest.FILE]


@pytest.mark.parametrize(
    "content", ["", "[]", "{}", '{"format": 2, "runs": []}', '{"format": 1, "runs": [{"run": 1}]}']
)
def test_a_file_that_is_no_manifest_is_named_in_one_line(tmp_path, content, capsys):
    (tmp_path / manifest.FILE).write_text(content)
    assert main(["sweep", *KEYS, f"output={tmp_path}"]) == 2
    error = capsys.readouterr().err
    assert f"{tmp_path / manifest.FILE}: not a manifest of a sweep" in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("key", "value"),
    [
        *(("run", ["a"]), ("folder", 5), ("episodes", "x"), ("episodes", True), ("name", 7)),
        *(("restarts", "z"), ("note", None), ("state", "lost"), ("log", "/etc/passwd")),
        *(("folder", "../../etc"), ("folder", "/dev"), ("folder", ".."), ("folder", "")),
        ("log", "logs/../../x"),
    ],
)
def test_a_row_with_a_wrong_value_is_named_in_one_line(tmp_path, key, value, capsys):
    row = {"run": "a", "name": "b", "folder": "c", "state": "new", "episodes": 2, key: value}
    (tmp_path / manifest.FILE).write_text(json.dumps({"format": 1, "runs": [row]}))
    for command in (["status", str(tmp_path)], [*KEYS, f"output={tmp_path}"]):
        assert main(["sweep", *command]) == 2
        error = capsys.readouterr().err
        assert f"{tmp_path / manifest.FILE}: not a manifest of a sweep" in error
        assert error.count("\n") == 1


def test_an_output_below_a_file_is_named(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert main(["sweep", *KEYS, f"output={tmp_path / 'file' / 'x'}"]) == 2
    assert "Not a directory" in (error := capsys.readouterr().err)
    assert "manifest" not in error


@pytest.mark.parametrize("arguments", [[], ["a", "b"], ["nowhere"]])
def test_status_of_no_folder_is_one_line(arguments, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["sweep", "status", *arguments]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_status_reads_the_files_of_the_runs(tmp_path, capsys, monkeypatch):
    """The states are those of the files, whatever the manifest says."""
    monkeypatch.setenv("COLUMNS", "200")
    all_jobs = jobs(tmp_path, "seed=range(0,6)")
    Manifest(tmp_path, "local").load(all_jobs)
    rows = list(manifest.read(tmp_path).values())
    runs = [RunFolder(tmp_path / row.folder) for row in rows]
    for run, job in zip(runs[:3], all_jobs, strict=False):
        RunFolder.create(job.configs[0], run.path.name).write_config(job.configs[0])
    for episode in range(1, 5):
        runs[0].append("metrics.jsonl", {"episode": episode, "coverage": 10.0 * episode})
    (runs[0].checkpoints / "step_000000060.safetensors").touch()
    runs[0].write("eval.json", {"checkpoint": "step_000000060.safetensors"})
    runs[1].append("metrics.jsonl", {"episode": 1, "coverage": 12.5})
    leases = Leases(tmp_path)
    assert leases.take(rows[1].run, TRAINING)
    assert leases.take(rows[3].run, SWEEP)
    rewritten = Manifest(tmp_path, "local")
    rewritten.load(all_jobs)
    rewritten.set(all_jobs[2], "running")  # its process was killed
    rewritten.set(all_jobs[4], "failed", note="exit status 2: no such thing")
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    assert main(["sweep", "status", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    lines = {line.split("seed ")[1][0]: line for line in said.splitlines() if "seed " in line}
    assert "finished" in lines["0"]
    assert "4/4" in lines["0"]
    assert "running" in lines["1"]
    assert "1/4" in lines["1"]
    assert "12.5 %" in lines["1"]
    assert "process " in lines["1"]
    assert "stopped" in lines["2"]
    assert "queued" in lines["3"]
    assert " failed " in said
    assert lines["4"] == "independent, paper, paper, seed 4: exit status 2: no such thing"
    assert "new" in lines["5"]
    assert "6 runs: " in said
    assert before == {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}


def test_a_training_without_a_sign_of_life_is_silent(tmp_path, monkeypatch, capsys):
    """The sweep may have ended before its machine died, so nobody has noticed it."""
    monkeypatch.setenv("COLUMNS", "200")
    Manifest(tmp_path, "local").load(jobs(tmp_path, "seed=0"))
    (row,) = manifest.read(tmp_path).values()
    lease = Leases(tmp_path).take(row.run, TRAINING)
    lease._write(replace(lease.record, host="node7", system="another boot", process=5))
    os.utime(lease.path, (time.time() - 1000,) * 2)
    assert main(["sweep", "status", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert " silent " in said
    assert "process 5 on node7, 1000 s ago" in said


def test_a_sweep_keeps_newer_rows_of_another_sweep_of_the_same_runs(tmp_path):
    first, second = Manifest(tmp_path, "submitit"), Manifest(tmp_path, "local")
    (a, b), (same_a, same_b) = jobs(tmp_path, "seed=0,1"), jobs(tmp_path, "seed=0,1")
    first.load([a, b])
    second.load([same_a, same_b])
    first.set(a, "queued", task="7", executor="submitit")
    second.set(same_b, "running", executor="local")
    rows = list(manifest.read(tmp_path).values())
    assert [(row.state, row.task) for row in rows] == [("queued", "7"), ("running", "")]
    # The other sweep takes the run over.
    second.set(same_a, "failed", note="no such thing")
    first.set(b, "stopped")
    rows = list(manifest.read(tmp_path).values())
    assert [(row.state, row.note) for row in rows] == [("failed", "no such thing"), ("stopped", "")]


def test_a_change_that_was_overwritten_is_written_again(tmp_path):
    ours = Manifest(tmp_path, "local")
    a, b = jobs(tmp_path, "seed=0,1")
    ours.load([a, b])
    before = (tmp_path / manifest.FILE).read_bytes()
    ours.set(a, "failed")
    (tmp_path / manifest.FILE).write_bytes(before)  # by a sweep that had read it before
    ours.set(b, "running")
    assert [row.state for row in manifest.read(tmp_path).values()] == ["failed", "running"]


def test_a_dry_run_writes_nothing(tmp_path):
    from emberlink.trainers.sweep.command import sweep

    output = tmp_path / "runs"
    assert sweep([*KEYS, f"output={output}"], Console(quiet=True), dry=True) == 0
    assert not output.exists()


def test_the_manifest_is_json(tmp_path):
    Manifest(tmp_path, "local").load(jobs(tmp_path, "seed=0,1"))
    content = json.loads((tmp_path / manifest.FILE).read_text())
    assert content["format"] == 1
    assert [row["state"] for row in content["runs"]] == ["new", "new"]
