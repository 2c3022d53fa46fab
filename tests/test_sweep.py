"""emberlink sweep: every combination once, and the same command again does what is left."""

import os
import signal
import subprocess
import sys
import time
from contextlib import nullcontext

import pytest
from rich.console import Console

from emberlink.trainers.cli.main import main
from emberlink.trainers.runs.run_folder import RunFolder
from emberlink.trainers.sweep.command import jobs_of, sweep

SMALL = [
    "setup=tuned",
    "env.horizon=40",
    "num_envs=2",
    "learner.hidden=[4,4]",
    "learner.batch_size=16",
    "evaluation.episodes=2",
    "evaluation.interval=0",
]


def names(jobs) -> list[str]:
    return [job.name for job in jobs]


def runs_in(folder) -> list[RunFolder]:
    return [RunFolder(file.parent) for file in sorted(folder.glob("*/config.yaml"))]


def test_every_combination_once():
    jobs = jobs_of(["consensus", "independent", "setup=paper,tuned", "seed=0,2,2"])
    assert names(jobs) == [
        f"{method}, {setup}, seed {seed}"
        for method in ("consensus", "independent")
        for setup in ("paper", "tuned")
        for seed in (0, 2)
    ]
    assert jobs[3].configs[0].seed == 2
    assert jobs[3].configs[0].setup == "tuned"


def test_lists_and_ranges_are_hydras():
    jobs = jobs_of(
        ["consensus", "learner.hidden=[8,8],[4,4]", "env.grid=[40,20]", "seed=range(1,3)"]
    )
    assert [(job.configs[0].learner.hidden, job.configs[0].seed) for job in jobs] == [
        ((8, 8), 1),
        ((8, 8), 2),
        ((4, 4), 1),
        ((4, 4), 2),
    ]
    assert {job.configs[0].env.grid for job in jobs} == {(40, 20)}


def test_all_methods_where_none_is_named_and_stacks_of_seeds():
    jobs = jobs_of(["seeds=[3,4]"])
    assert names(jobs) == [
        f"{method}, paper, seed 3,4"
        for method in ("consensus", "independent", "positional", "shared_memory")
    ]
    assert [config.seed for config in jobs[0].configs] == [3, 4]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["consensos"], "consensos"),
        (["consensus", "seed=0,-1"], "seed"),
        (["consensus", "setup=paper,tunned"], "tunned"),
        (["consensus", "learner.gama=0.9,0.8"], "learner.gama"),
        (["consensus", "--jobs", "0"], "--jobs"),
    ],
)
def test_mistakes_are_named_before_anything_is_trained(arguments, said, capsys, tmp_path):
    with pytest.raises(SystemExit) if "--jobs" in arguments else nullcontext():
        assert main(["sweep", *arguments, f"output={tmp_path}"]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert not any(tmp_path.iterdir())


def test_what_is_finished_is_skipped_and_the_rest_made(tmp_path, capsys):
    console = Console(width=200)
    arguments = [*SMALL, "independent", "episodes=1", f"output={tmp_path}"]
    assert sweep([*arguments, "seed=0"], console) == 0
    (first,) = runs_in(tmp_path)
    before = {file: file.stat().st_mtime_ns for file in first.path.rglob("*")}
    assert sweep([*arguments, "seed=0,1"], console) == 0
    runs = runs_in(tmp_path)
    assert [run.config().seed for run in runs] == [0, 1]
    assert all((run.path / "eval.json").exists() for run in runs)
    assert {file: file.stat().st_mtime_ns for file in first.path.rglob("*")} == before
    assert "2 runs, of which 1 are finished" in capsys.readouterr().out


def test_a_stopped_sweep_goes_on_and_ends_where_an_unbroken_one_does(tmp_path):
    program = "from emberlink.trainers.cli.main import main; raise SystemExit(main())"
    broken, whole = tmp_path / "broken", tmp_path / "whole"
    # Long enough to be met in the middle of it.
    arguments = ["sweep", *SMALL, "consensus", "episodes=12", "checkpoint_steps=20", "seed=5"]
    process = subprocess.Popen(
        [sys.executable, "-c", program, *arguments, f"output={broken}"],
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        stdout=subprocess.DEVNULL,
    )
    deadline = time.monotonic() + 120
    while not any(run.lines() for run in runs_in(broken)):
        assert time.monotonic() < deadline
        assert process.poll() is None
        time.sleep(0.05)
    process.send_signal(signal.SIGTERM)
    assert process.wait(timeout=120) == 143
    (run,) = runs_in(broken)
    assert 0 < len(run.lines()) < 12
    assert main([*arguments, f"output={broken}"]) == 0
    assert main([*arguments, f"output={whole}"]) == 0
    (run,), (unbroken,) = runs_in(broken), runs_in(whole)
    for file in ("metrics.jsonl", "eval.json"):
        assert (run.path / file).read_bytes() == (unbroken.path / file).read_bytes()


def test_one_run_that_fails_does_not_end_the_others(tmp_path, capsys):
    arguments = [*SMALL, "independent", "episodes=1", f"output={tmp_path}", "seed=0"]
    assert sweep(arguments, Console(width=300)) == 0
    (run,) = runs_in(tmp_path)
    (run.path / "eval.json").unlink()
    for file in (run.path / "checkpoints").iterdir():
        file.write_bytes(b"damaged")
    assert main(["sweep", *arguments[:-1], "seed=0,1"]) == 1
    printed = " ".join(capsys.readouterr().out.split())
    assert "exit status 2" in printed
    assert len([run for run in runs_in(tmp_path) if (run.path / "eval.json").exists()]) == 1
