"""Tests emberlink sweep: every combination is trained once, and repeating it resumes."""

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import pytest
from inside import Inside
from rich.console import Console

from emberlink.trainers.cli.main import main
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.runs.run_folder import RunFolder
from emberlink.trainers.sweep import claims, executors, scheduler
from emberlink.trainers.sweep.command import sweep
from emberlink.trainers.sweep.jobs import identity, jobs_of

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
        f"{method}, {setup}, paper, seed {seed}"
        for method in ("consensus", "independent")
        for setup in ("paper", "tuned")
        for seed in (0, 2)
    ]
    assert jobs[3].configs[0].seed == 2
    assert jobs[3].configs[0].setup == "tuned"


def test_worlds_are_combined_too():
    jobs = jobs_of(["consensus", "world=front,relay"])
    assert names(jobs) == ["consensus, paper, front, seed 0", "consensus, paper, relay, seed 0"]
    assert [job.configs[0].env.base for job in jobs] == [None, (0.0, 30.0)]


def test_lists_and_ranges_follow_hydras_syntax():
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


def test_all_methods_by_default_and_stacks_of_seeds():
    jobs = jobs_of(["seeds=[3,4]"])
    assert names(jobs) == [
        f"{method}, paper, paper, seed 3,4"
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
def test_errors_are_named_before_training(arguments, said, capsys, tmp_path):
    with pytest.raises(SystemExit) if "--jobs" in arguments else nullcontext():
        assert main(["sweep", *arguments, f"output={tmp_path}"]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert not any(tmp_path.iterdir())


CHECKPOINT = "step_000000040.safetensors"


def begin(config) -> RunFolder:
    """Creates the run folder of a training that has just started."""
    run = RunFolder.create(config)
    run.write_config(config)
    return run


def finish(run: RunFolder, episodes: int = 15) -> None:
    """Adds the files of a training and its evaluation."""
    for episode in range(len(run.lines()) + 1, episodes + 1):
        run.append("metrics.jsonl", {"episode": episode, "coverage": 50.0})
    (run.checkpoints / CHECKPOINT).touch()
    run.write("eval.json", {"checkpoint": CHECKPOINT})


def configs_of(arguments) -> list:
    """Returns the configuration of each seed of a new training."""
    config = resolve(arguments[0], arguments[1:])
    return [replace(config, seed=seed) for seed in config.seeds or (config.seed,)]


class Instant(executors.Executor):
    """Finishes each task immediately, as an alternative to the executor with processes."""

    def __init__(self, fails=lambda arguments: False):
        self.submitted: list[list[str]] = []
        self._fails = fails

    def slots(self, tasks):
        return 2

    def submit(self, task):
        arguments = list(task.arguments)
        self.submitted.append(arguments)
        if self._fails(arguments):
            task.log.write_text("\nemberlink train: no such thing\n\n")
            return 2
        if arguments[0].startswith("resume="):
            first = RunFolder(arguments[0].removeprefix("resume="))
            seeds = first.config(device="cpu").seeds or (first.config(device="cpu").seed,)
            for run in runs_in(first.path.parent):
                if run.config(device="cpu").seed in seeds:
                    finish(run)
        else:
            for config in configs_of(arguments):
                finish(begin(config), config.episodes)
        return 0

    def poll(self, handle):
        return handle

    def cancel(self, handle):
        pass


def swept(arguments, executor=None) -> list[list[str]]:
    """Returns the arguments of the trainings that a sweep submits, without the settings."""
    executor = executor or Instant()
    assert sweep([*SMALL, *arguments], Console(width=200), executor=executor) == 0
    return [[text for text in task if text not in SMALL] for task in executor.submitted]


def test_finished_runs_are_skipped(tmp_path, capsys):
    output = f"output={tmp_path}"
    assert swept(["independent", "episodes=1", output, "seed=0"]) == [
        ["independent", "episodes=1", output, "seed=0"]
    ]
    (first,) = runs_in(tmp_path)
    before = {file: file.stat().st_mtime_ns for file in first.path.rglob("*")}
    assert len(swept(["independent", "episodes=1", output, "seed=0,1"])) == 1
    assert [run.config().seed for run in runs_in(tmp_path)] == [0, 1]
    assert {file: file.stat().st_mtime_ns for file in first.path.rglob("*")} == before
    assert "2 runs, of which 1 are finished" in capsys.readouterr().out


def test_a_failing_run_does_not_stop_the_others(tmp_path, capsys):
    executor = Instant(fails=lambda arguments: "seed=0" in arguments)
    arguments = [*SMALL, "independent", f"output={tmp_path}", "seed=0,1,2"]
    assert sweep(arguments, Console(width=300), executor=executor) == 1
    assert len(runs_in(tmp_path)) == 2
    said = capsys.readouterr().out
    assert "exit status 2: emberlink train: no such thing (log: " in said
    assert "compare them with" not in said


def test_a_run_folder_is_read_once(tmp_path, monkeypatch):
    output = f"output={tmp_path}"
    swept(["independent", output, "seed=range(0,3)"])
    read = []
    config = RunFolder.config
    monkeypatch.setattr(
        RunFolder, "config", lambda self, **about: read.append(self.path) or config(self, **about)
    )
    jobs = [*SMALL, "independent", output, "seed=range(0,6)"]

    class Slow(Instant):
        looks = 0

        def poll(self, handle):
            self.looks += 1
            return handle if self.looks % 4 == 0 else None

    assert sweep(jobs, Console(), executor=Slow()) == 0
    assert sorted(read) == sorted({*read})
    assert len(read) == 6


def test_the_device_is_not_part_of_the_identity_of_a_run(tmp_path):
    """The run is resumed on the requested device."""
    output = f"output={tmp_path}"
    (config,) = configs_of(["independent", *SMALL, output])
    done, stopped = begin(config), begin(replace(config, seed=1))
    finish(done)
    for run in (done, stopped):
        file = run.path / "config.yaml"
        file.write_text(file.read_text().replace("device: cpu", "device: cuda:7"))
    assert swept(["independent", output, "seed=0,1"]) == [[f"resume={stopped.path}", "device=cpu"]]


def test_a_resumed_run_gets_the_settings_that_may_change(tmp_path):
    output = f"output={tmp_path}"
    (config,) = configs_of(["independent", *SMALL, output])
    run = begin(config)
    more = ["logger=csv", "checkpoint_interval=3", "device=cpu"]
    assert swept(["independent", output, *more]) == [[f"resume={run.path}", *more]]


def test_a_config_that_cannot_be_read_is_named(tmp_path, capsys):
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "config.yaml").write_text("method: [")
    swept(["independent", f"output={tmp_path}"])
    said = "".join(capsys.readouterr().out.split("\n"))
    assert f"note: {tmp_path / 'old'} is left out: " in said


def test_a_run_without_metrics_is_not_finished(tmp_path):
    output = f"output={tmp_path}"
    swept(["independent", output])
    (run,) = runs_in(tmp_path)
    (run.path / "metrics.jsonl").write_text("")
    assert swept(["independent", output]) == [[f"resume={run.path}", "device=cpu"]]


def test_a_seed_in_two_stacks_is_trained_once(tmp_path):
    output = f"output={tmp_path}"
    assert swept(["independent", output, "seeds=[0,1],[1,2]"]) == [
        ["independent", output, "seeds=[0,1]"],
        ["independent", output, "seeds=[2]"],
    ]
    assert [run.config().seed for run in runs_in(tmp_path)] == [0, 1, 2]


def test_a_stack_uses_runs_that_were_trained_separately(tmp_path):
    output = f"output={tmp_path}"
    swept(["independent", output, "seed=0,1"])
    assert swept(["independent", output, "seeds=[0,1,2,3]"]) == [
        ["independent", output, "seeds=[2,3]"]
    ]
    assert swept(["independent", output, "seed=range(0,4)"]) == []


def test_a_stack_is_resumed_as_a_whole(tmp_path):
    """This includes seeds that are requested separately and partly finished."""
    output = f"output={tmp_path}"
    stack = [
        begin(config) for config in configs_of(["independent", *SMALL, output, "seeds=[0,1,2]"])
    ]
    finish(stack[0])
    assert swept(["independent", output, "seed=range(0,4)"]) == [
        [f"resume={stack[1].path}", "device=cpu"],
        ["independent", output, "seed=3"],
    ]


class Later(Instant):
    """Takes a second for a task and creates its run folder at the end."""

    def submit(self, task):
        with (task.log.parent / "submitted").open("a") as file:
            file.write(f"{task.arguments[-1]}\n")
        return time.monotonic() + 1, configs_of(task.arguments)

    def poll(self, handle):
        if time.monotonic() < handle[0]:
            return None
        for config in handle[1]:
            finish(begin(config), config.episodes)
        return 0


def test_two_simultaneous_sweeps_train_every_run_once(tmp_path):
    """The second takes jobs that the first has not started, and waits for the others."""
    arguments = [*SMALL, "independent", f"output={tmp_path}", "seed=range(0,4)"]

    def work():
        raise SystemExit(sweep(arguments, Console(quiet=True), executor=Later()))

    both = [multiprocessing.get_context("fork").Process(target=work) for _ in range(2)]
    for process in both:
        process.start()
    for process in both:
        process.join()
    assert [process.exitcode for process in both] == [0, 0]
    submitted = (tmp_path / "logs" / "submitted").read_text().split()
    assert sorted(submitted) == [f"seed={seed}" for seed in range(4)]


PARENT = """
import os, sys
from pathlib import Path
from emberlink.trainers.sweep.executors import Task, make
task = Task(sys.argv[2:], Path(sys.argv[1]), [int(os.environ["LOCK"])])
print(make("local", {}).submit(task).pid, flush=True)
os.read(0, 1)
"""


def test_a_killed_sweep_ends_its_trainings(tmp_path):
    """A run stays claimed until its training has ended."""
    (job,) = jobs_of(["independent", *SMALL, "episodes=10000", f"output={tmp_path}"])
    claim = claims.claim(tmp_path, job.identities)
    assert claim is not None
    arguments = [tmp_path / "log.txt", *job.arguments]
    parent = subprocess.Popen(
        [sys.executable, "-c", PARENT, *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        pass_fds=claim.handles,
        env={**os.environ, "LOCK": str(claim.handles[0])},
    )
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    claim.release()
    assert claims.claim(tmp_path, job.identities) is None
    os.kill(child, 0)
    parent.kill()
    parent.wait()
    deadline = time.monotonic() + 60
    while (again := claims.claim(tmp_path, job.identities)) is None:
        assert time.monotonic() < deadline
        time.sleep(0.05)
    again.release()
    # A zombie process may remain, but holds no lock.
    status = Path(f"/proc/{child}/stat")
    assert not status.exists() or status.read_text().split()[2] == "Z"


def test_claims_are_per_run(tmp_path):
    first_seed, second_seed = (
        identity(c) for c in configs_of(["independent", *SMALL, "seeds=[0,1]"])
    )
    first = claims.claim(tmp_path, [first_seed])
    assert first is not None
    assert claims.claim(tmp_path, [second_seed, first_seed]) is None
    free = claims.claim(tmp_path, [second_seed])
    assert free is not None
    first.release()
    free.release()
    both = claims.claim(tmp_path, [second_seed, first_seed])
    assert both is not None
    both.release()


@pytest.mark.parametrize(
    ("argument", "said"),
    [
        ("executor=slurm", "executor='slurm' is not known; known: local"),
        ("executor.cores=2", "'executor.cores' is not known; known: executor.workers"),
        ("executor.workers=0", "executor.workers=0"),
        ("executor.workers=two", "executor.workers=two"),
        ("output=a,b", "a sweep has one output folder"),
    ],
)
def test_executors_are_chosen_and_checked(argument, said, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["sweep", *SMALL, "independent", argument]) == 2
    assert said in capsys.readouterr().err
    assert not any(tmp_path.iterdir())


def test_every_executor_has_a_file_and_settings():
    assert executors.known() == ["local"]
    executor = executors.make("local", {"workers": 3})
    assert (executor.slots(9), executor.slots(2)) == (3, 2)


@pytest.mark.slow
def test_a_resumed_sweep_equals_an_uninterrupted_one(tmp_path):
    broken, whole = tmp_path / "broken", tmp_path / "whole"
    # Long enough to be interrupted during the training.
    arguments = [*SMALL, "consensus", "episodes=8", "checkpoint_steps=20", "seed=5"]

    def stop() -> None:
        deadline = time.monotonic() + 120
        while not any(run.lines() for run in runs_in(broken)) and time.monotonic() < deadline:
            time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGTERM)

    stopping = threading.Thread(target=stop)
    stopping.start()
    # The training is a process of its own, which the sweep stops.
    assert main(["sweep", *arguments, f"output={broken}"]) == 143
    stopping.join()
    (run,) = runs_in(broken)
    assert 0 < len(run.lines()) < 8
    assert sweep([*arguments, f"output={broken}"], Console(quiet=True), executor=Inside()) == 0
    assert main(["train", *arguments[-4:], *SMALL, f"output={whole}"]) == 0
    (run,), (unbroken,) = runs_in(broken), runs_in(whole)
    for file in ("metrics.jsonl", "eval.json"):
        assert (run.path / file).read_bytes() == (unbroken.path / file).read_bytes()


def test_a_task_that_failed_before_its_log_is_reported(tmp_path):
    log = tmp_path / "log.txt"
    assert scheduler._last_line(log) == "there is no log"
    log.write_text("first\nlast\n\n")
    assert scheduler._last_line(log) == "last"
