"""Tests emberlink sweep: every combination is trained once, and repeating it resumes."""

import io
import json
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
import torch
from inside import Inside
from rich.console import Console

from emberlink.trainers.cli.main import main
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.runs.run_folder import RunFolder
from emberlink.trainers.sweep import executors, manifest
from emberlink.trainers.sweep.command import sweep
from emberlink.trainers.sweep.jobs import folder_name, jobs_of
from emberlink.trainers.sweep.leases import SWEEP, TRAINING, Leases
from emberlink.trainers.sweep.plan import plan, stacked
from emberlink.trainers.sweep.run_index import RunIndex
from emberlink.trainers.training.folders import SEED_RUNS, find_runs

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


def test_what_is_swept_is_in_the_name():
    swept = ["learner=ippo,mappo", "policy.hold=1,2", "seed=0,1", "episodes=3"]
    jobs = jobs_of(["independent", *swept])
    first = "independent, paper, paper, learner=ippo, policy.hold=1, seed 0"
    assert (len(jobs), names(jobs)[0], len(set(names(jobs)))) == (8, first, 8)
    (job,) = stacked(plan(jobs[:2], {}), 2)
    assert job.name == first + ",1"


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
        for method in ("consensus", "independent", "maps", "positional", "shared_memory")
    ]
    assert [config.seed for config in jobs[0].configs] == [3, 4]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["consensos"], "consensos"),
        (["consensus", "seed=0,-1"], "seed"),
        (["consensus", "setup=paper,tunned"], "tunned"),
        (["consensus", "learner.gama=0.9,0.8"], "learner.gama"),
        (["consensus", "policy.hold=5,7", "env.horizon=20"], "env.horizon=20: must be a multiple"),
        (
            ["independent", "maps", "setup=strong", "learner=imitation"],
            "independent, strong, paper, seed 0: learner=imitation: the teacher flies by the maps",
        ),
        (
            ["consensus", *SMALL, "policy.memory=gru", "learner.sequence=4,41"],
            "learner.sequence=41, seed 0: learner.sequence=41: an episode has 40 decisions",
        ),
        (["consensus", "fire=file", "fire.path=/no/fire"], "/no/fire"),
        (["maps", "learner=imitation", "policy.hold=7", "env.horizon=20"], "multiple of"),
        (["consensus", *SMALL, "learner.warm_start=nowhere"], "learner.warm_start=nowhere: "),
        (["consensus", "seed=range(3,3)"], "no run: a key has no value"),
        (["consensus", "seed=range(0,5,0)"], "seed=range(0,5,0)"),
        (["consensus", "seed=" + "[" * 600], "'seed="),
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


def about(arguments) -> tuple[list[RunFolder], list[str]]:
    """Returns the run folders of a task, and its other arguments."""
    return find_runs(Path(arguments[0].removeprefix("resume="))), list(arguments[1:])


class Instant(executors.Executor):
    """Finishes each task immediately, as an alternative to the executor with processes."""

    def __init__(self, fails=lambda arguments: False):
        self.submitted: list[list[str]] = []
        self._fails = fails

    def slots(self, tasks):
        return 2

    def submit(self, task):
        self.submitted.append(described(task.arguments))
        if self._fails(self.submitted[-1]):
            task.log.write_text("\nemberlink train: no such thing\n\n")
            return 2
        for run in about(task.arguments)[0]:
            finish(run, run.config(device="cpu").episodes)
        return 0

    def poll(self, handle):
        return handle

    def cancel(self, handle):
        pass


def described(arguments) -> list[str]:
    """Returns the arguments of a task; `new METHOD SEEDS` stands for a folder of the sweep."""
    runs, others = about(arguments)
    configs = [run.config(device="cpu") for run in runs]
    if runs[0].path.name != folder_name(configs[0]):
        return [arguments[0], *others]
    seeds = sorted(config.seed for config in configs)
    return [f"new {configs[0].method} {','.join(map(str, seeds))}", *others]


def swept(arguments, executor=None) -> list[list[str]]:
    """Returns the arguments of the trainings that a sweep submits."""
    executor = executor or Instant()
    assert sweep([*SMALL, *arguments], Console(width=200), executor=executor) == 0
    return executor.submitted


def test_seeds_that_are_trained_as_a_stack_are_checked_as_one(tmp_path, monkeypatch):
    checked = []
    check = "emberlink.trainers.sweep.command.check_setup"
    monkeypatch.setattr(check, lambda config: checked.append(config.seeds))
    arguments = ["independent", *SMALL, "seed=0,1,2", f"output={tmp_path}", "executor.seeds=2"]
    assert sweep(arguments, Console(width=200), dry=True) == 0
    assert checked == [(0, 1), ()]


def test_finished_runs_are_skipped(tmp_path, capsys):
    output = f"output={tmp_path}"
    assert swept(["independent", "episodes=1", output, "seed=0"]) == [
        ["new independent 0", "device=cpu"]
    ]
    (first,) = runs_in(tmp_path)
    before = {file: file.stat().st_mtime_ns for file in first.path.rglob("*")}
    assert len(swept(["independent", "episodes=1", output, "seed=0,1"])) == 1
    assert [run.config().seed for run in runs_in(tmp_path)] == [0, 1]
    assert {file: file.stat().st_mtime_ns for file in first.path.rglob("*")} == before
    assert "2 runs, of which 1 are finished" in capsys.readouterr().out


def test_a_finished_run_is_found_beside_an_unfinished_one(tmp_path):
    settings = ["independent", "episodes=1", f"output={tmp_path}"]
    (config,) = configs_of([settings[0], *SMALL, *settings[1:]])
    for name in "abc":
        run = begin(config)
        run.path.rename(tmp_path / name)
    finish(RunFolder(tmp_path / "b"), 1)
    assert swept(settings) == []


def test_a_trained_policy_of_the_package_is_not_the_users_run(tmp_path):
    settings = ["independent", "episodes=1", f"output={tmp_path}"]
    (config,) = configs_of([settings[0], *SMALL, *settings[1:]])
    run = begin(config)
    finish(run, 1)
    run.path.rename(tmp_path / "pretrained_tuned_independent_s0")
    assert swept(settings) == [["new independent 0", "device=cpu"]]


def test_yaml_files_that_change_during_a_sweep_do_not_change_its_runs(tmp_path, monkeypatch):
    file = tmp_path / "mine" / "setup" / "own.yaml"
    file.parent.mkdir(parents=True)
    file.write_text("# @package _global_\ndefaults: [tuned]\nlearner: {gamma: 0.5}\n")
    monkeypatch.setenv("EMBERLINK_CONFIGS", str(tmp_path / "mine"))
    output = tmp_path / "runs"
    (job,) = plan(jobs_of(["independent", *SMALL, "setup=own", f"output={output}"]), {})
    file.write_text("# @package _global_\ndefaults: [tuned]\nlearner: {gamma: 0.6}\n")
    job.create_folders()
    (run,) = runs_in(output)
    assert run.config().learner.gamma == 0.5


def test_a_failing_run_does_not_stop_the_others(tmp_path, capsys):
    executor = Instant(fails=lambda task: task[0].endswith(" 0"))
    arguments = [*SMALL, "independent", f"output={tmp_path}", "seed=0,1,2"]
    assert sweep(arguments, Console(width=300), executor=executor) == 1
    assert [len(run.lines()) for run in runs_in(tmp_path)] == [0, 15, 15]
    states = {row.name[-1]: row.state for row in manifest.read(tmp_path).values()}
    assert states == {"0": "failed", "1": "finished", "2": "finished"}
    said = capsys.readouterr().out
    assert "exit status 2: emberlink train: no such thing (log: " in said
    assert "compare them with" not in said


def test_the_table_has_a_row_for_each_run_and_the_next_command_is_quoted(tmp_path, capsys):
    output = tmp_path / "my runs"
    swept(["independent", f"output={output}", "seeds=[0,1]"])
    said = capsys.readouterr().out
    for run in runs_in(output):
        name = f"independent, tuned, paper, seed {run.config().seed}"
        assert f"{name} finished {run.path.name}" in " ".join(said.replace("│", " ").split())
    assert f"emberlink compare '{output}'" in said.replace("\n", "")


def test_a_run_folder_is_read_once(tmp_path, monkeypatch):
    output = f"output={tmp_path}"
    swept(["independent", output, "seed=range(0,3)"])
    read = []
    add = RunIndex._add
    monkeypatch.setattr(RunIndex, "_add", lambda self, run: read.append(run.path) or add(self, run))
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
    assert swept(["independent", output]) == [["new independent 0", "device=cpu"]]
    assert runs_in(tmp_path)[0].path == run.path


def test_a_seed_in_two_stacks_is_trained_once(tmp_path):
    output = f"output={tmp_path}"
    assert swept(["independent", output, "seeds=[0,1],[1,2]"]) == [
        ["new independent 0,1", "device=cpu"],
        ["new independent 2", "device=cpu"],
    ]
    assert [run.config().seed for run in runs_in(tmp_path)] == [0, 1, 2]


def test_a_stack_uses_runs_that_were_trained_separately(tmp_path):
    output = f"output={tmp_path}"
    swept(["independent", output, "seed=0,1"])
    assert swept(["independent", output, "seeds=[0,1,2,3]"]) == [
        ["new independent 2,3", "device=cpu"]
    ]
    assert swept(["independent", output, "seed=range(0,4)"]) == []


def test_a_stack_is_resumed_as_a_whole(tmp_path):
    """This includes seeds that are requested separately and partly finished."""
    output = f"output={tmp_path}"
    stack = [
        begin(config) for config in configs_of(["independent", *SMALL, output, "seeds=[0,1,2]"])
    ]
    for run in stack:
        run.write(SEED_RUNS, {"folders": [other.path.name for other in stack]})
    finish(stack[0])
    assert swept(["independent", output, "seed=range(0,4)"]) == [
        [f"resume={stack[1].path}", "device=cpu"],
        ["new independent 3", "device=cpu"],
    ]


class Later(Instant):
    """Takes a second for a task."""

    def submit(self, task):
        with (task.log.parent / "submitted").open("a") as file:
            file.write(f"{described(task.arguments)[0]}\n")
        return time.monotonic() + 1, about(task.arguments)[0]

    def poll(self, handle):
        if time.monotonic() < handle[0]:
            return None
        for run in handle[1]:
            finish(run)
        return 0


def test_two_simultaneous_sweeps_train_every_run_once(tmp_path):
    """The second takes jobs that the first has not started, and waits for the others."""
    arguments = [*SMALL, "independent", f"output={tmp_path}", "seed=range(0,4)"]

    def work():
        torch.set_num_threads(1)  # the threads of this process do not exist in its forks
        raise SystemExit(sweep(arguments, Console(quiet=True), executor=Later()))

    both = [multiprocessing.get_context("fork").Process(target=work) for _ in range(2)]
    for process in both:
        process.start()
    for process in both:
        process.join()
    assert [process.exitcode for process in both] == [0, 0]
    submitted = (tmp_path / "logs" / "submitted").read_text().splitlines()
    assert sorted(submitted) == [f"new independent {seed}" for seed in range(4)]


PARENT = """
import json, os, sys
from pathlib import Path
from emberlink.trainers.sweep.executors import Task, make
log, output, leases = Path(sys.argv[1]), Path(sys.argv[2]), json.loads(sys.argv[3])
print(make("local", {}).submit(Task(sys.argv[4:], log, leases, output)).pid, flush=True)
os.read(0, 1)
"""


def test_a_killed_sweep_ends_its_trainings(tmp_path):
    """A run stays leased until its training has ended."""
    (job,) = jobs_of(["independent", *SMALL, "episodes=10000", f"output={tmp_path}"])
    (name,), leases = job.names, Leases(tmp_path)
    ours = leases.take(name, SWEEP)
    run = begin(job.configs[0])
    tokens = json.dumps({name: ours.record.token})
    parent = subprocess.Popen(
        [
            sys.executable,
            "-c",
            PARENT,
            tmp_path / "log.txt",
            tmp_path,
            tokens,
            f"resume={run.path}",
        ],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    deadline = time.monotonic() + 60
    while not run.lines():
        assert time.monotonic() < deadline
        time.sleep(0.05)
    assert leases.newest(name).role == TRAINING
    assert leases.take(name, SWEEP) is None
    os.kill(child, 0)
    parent.kill()
    parent.wait()
    while leases.take(name, SWEEP) is None:
        assert time.monotonic() < deadline
        time.sleep(0.05)
    assert run.states()


@pytest.mark.parametrize(
    ("argument", "said"),
    [
        ("executor=slurm", "executor='slurm' is not known; known: local, ray, submitit"),
        ("executor.cores=2", "'executor.cores' is not known; known: executor.workers"),
        ("executor.workers=0", "executor.workers=0"),
        ("executor.workers=two", "executor.workers=two"),
        ("executor.workers=2024-13-01", "executor.workers=2024-13-01 is not YAML"),
        ("executor.workers=" + "9" * 5000, "is not YAML"),
        ("output=a,b", "a sweep has one output folder"),
    ],
)
def test_executors_are_chosen_and_checked(argument, said, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["sweep", *SMALL, "independent", argument]) == 2
    assert said in capsys.readouterr().err
    assert not any(tmp_path.iterdir())


def test_every_executor_has_a_file_and_settings():
    assert executors.known() == ["local", "ray", "submitit"]
    executor = executors.make("local", {"workers": 3})
    assert (executor.slots(9), executor.slots(2)) == (3, 2)


@pytest.mark.heavy
@pytest.mark.parametrize("learner", ["ddpg", "mappo"])
def test_a_resumed_sweep_equals_an_uninterrupted_one(learner, tmp_path):
    broken, whole = tmp_path / "broken", tmp_path / "whole"
    # Long enough to be interrupted during the training.
    own = [text for text in SMALL if learner == "ddpg" or "batch_size" not in text]
    own += [f"learner={learner}", *([] if learner == "ddpg" else ["policy.memory=gru"])]
    arguments = ["consensus", *own, "episodes=12", "checkpoint_steps=20", "seed=5"]

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
    assert 0 < len(run.lines()) < 12
    assert sweep([*arguments, f"output={broken}"], Console(quiet=True), executor=Inside()) == 0
    assert main(["train", *arguments, f"output={whole}"]) == 0
    (run,), (unbroken,) = runs_in(broken), runs_in(whole)
    for file in ("metrics.jsonl", "eval.json"):
        assert (run.path / file).read_bytes() == (unbroken.path / file).read_bytes()


def test_a_task_that_failed_before_its_log_is_reported(tmp_path):
    (job,) = jobs_of(["independent", f"output={tmp_path}"])
    assert job.last_line() == "there is no log"
    job.open_log()
    assert job.last_line() == "the log is empty"
    job.log.write_text("first\nlast\n\n")
    assert job.last_line() == "last"
    job.log.write_text("\n")
    assert job.last_line() == "the log is empty"


def test_the_log_of_many_seeds_has_a_short_name(tmp_path):
    few, many = ([*range(count)] for count in (8, 100))
    names = []
    for seeds in (few, many):
        (job,) = jobs_of(["independent", f"seeds={seeds}".replace(" ", ""), f"output={tmp_path}"])
        job.open_log()
        names.append(job.log.stem)
    assert names[0] == "paper_paper_independent_s0-1-2-3-4-5-6-7"
    assert names[1] == "paper_paper_independent_s0-and-99-more"


def test_a_dry_run_prints_each_run_on_a_line(tmp_path):
    shown = io.StringIO()
    swept = ["learner.hidden=[128,128],[256,256]", "env.radio.range=10,20"]
    arguments = ["consensus", *SMALL[:3], *swept, f"output={tmp_path / ('x' * 60)}"]
    assert sweep(arguments, Console(file=shown, width=80), dry=True) == 0
    first, *lines = shown.getvalue().splitlines()
    assert first.endswith("x" * 60)
    assert [line.endswith("seed 0: new") for line in lines] == [True] * 4


def test_every_job_has_a_log_of_its_own(tmp_path):
    """An executor may write to the logs long after all jobs were submitted."""
    jobs = jobs_of(["independent", "learner.gamma=0.9,0.95", f"output={tmp_path}"])
    for job in jobs:
        job.open_log()
    first, second = (job.log for job in jobs)
    assert first != second
    assert first.exists()
    assert second.exists()
    # A job that was cancelled before it wrote leaves these files.
    first.rename(first.with_suffix(".status"))
    second.rename(second.with_suffix(".stop"))
    (job,) = jobs_of(["independent", f"output={tmp_path}"])
    job.open_log()
    assert job.log not in (first, second)
    job.drop_log()
    assert not job.log.exists()
    job.open_log()
    job.log.write_text("a line")
    job.drop_log()
    assert job.log.exists()
