"""Tests emberlink sweep: every combination is trained once, and repeating it trains the rest."""

import os
import re
import signal
import subprocess
import sys
import threading
import time

import pytest
from rich.console import Console

from emberlink.trainers.cli.main import main
from emberlink.trainers.runs import checkpoint
from emberlink.trainers.runs.lock import Lock
from emberlink.trainers.runs.run_folder import RunFolder
from emberlink.trainers.sweep.combinations import combinations
from emberlink.trainers.sweep.command import sweep
from emberlink.trainers.sweep.executors.base import Executor, Task, make

SMALL = [
    "setup=tuned",
    "env.horizon=40",
    "num_envs=2",
    "learner.hidden=[4,4]",
    "learner.batch_size=16",
    "evaluation.episodes=2",
    "evaluation.interval=0",
]


def names(arguments) -> list[str]:
    return [run.name for run in combinations(arguments)]


def folders_in(output) -> list[RunFolder]:
    return [RunFolder(file.parent) for file in sorted(output.glob("*/config.yaml"))]


def test_every_combination_once():
    assert names(["consensus", "independent", "setup=paper,tuned", "seed=0,2,2"]) == [
        f"{method}, setup={setup}, seed={seed}"
        for method in ("consensus", "independent")
        for setup in ("paper", "tuned")
        for seed in (0, 2)
    ]
    found = combinations(["consensus", "seed=range(1,3)", "learner.hidden=[8,8],[4,4]"])
    assert [(run.config.seed, run.config.learner.hidden) for run in found] == [
        (seed, hidden) for seed in (1, 2) for hidden in ((8, 8), (4, 4))
    ]


def finish(run: RunFolder) -> None:
    """Adds the files of a training and its evaluation."""
    for episode in range(len(run.metrics()) + 1, run.config().episodes + 1):
        run.append({"episode": episode, "coverage": 50.0})
    checkpoint.write(run.newest, checkpoint.header_of(run.config(), 40), {})
    run.write("eval.json", {"step": 40})


class Instant(Executor):
    """Finishes each task at its second poll; the contract of a user's executor."""

    workers = 2

    def __init__(self, fails=()):
        self.tasks: list[Task] = []
        self.cancelled: list[int] = []
        self._fails = fails

    def submit(self, tasks):
        first = len(self.tasks)
        self.tasks += tasks
        handles = {first + place: 0 for place in range(len(tasks))}
        self.running = {**getattr(self, "running", {}), **handles}
        assert len(self.running) <= self.workers
        return list(handles)

    def poll(self, handle):
        if self.running[handle] == 0:
            self.running[handle] = 1
            return None
        del self.running[handle]
        run = RunFolder(self.tasks[handle].run)
        if run.config().seed in self._fails:
            self.tasks[handle].log.write_text("\nemberlink train: no such thing\n\n")
            return 2
        if handle not in self.cancelled:
            finish(run)
        return 0

    def cancel(self, handle):
        self.cancelled.append(handle)


def swept(tmp_path, *arguments, executor=None) -> list[int]:
    """Returns the seeds of the trainings that a sweep submits."""
    executor = executor or Instant()
    output = f"output={tmp_path / 'runs'}"
    assert sweep(["independent", *SMALL, output, *arguments], Console(), executor=executor) == 0
    return [RunFolder(task.run).config().seed for task in executor.tasks]


def test_finished_runs_are_skipped_and_others_resumed(tmp_path, capsys):
    assert swept(tmp_path, "episodes=1", "seed=0,1,2") == [0, 1, 2]
    assert swept(tmp_path, "episodes=1", "seed=0,1,2") == []
    assert swept(tmp_path, "episodes=1", "seed=range(0,4)") == [3]
    assert "4 runs, of which 3 are finished" in capsys.readouterr().out
    stopped = folders_in(tmp_path / "runs")[1]
    (stopped.path / "eval.json").unlink()
    executor = Instant()
    assert swept(tmp_path, "episodes=1", "seed=range(0,4)", executor=executor) == [1]
    assert executor.tasks[0].run == stopped.path
    assert len(folders_in(tmp_path / "runs")) == 4


def test_a_run_is_known_by_its_configuration_and_not_by_its_name(tmp_path):
    swept(tmp_path, "episodes=1")
    (run,) = folders_in(tmp_path / "runs")
    run.path.rename(run.path.with_name("by_hand"))
    assert swept(tmp_path, "episodes=1") == []
    executor = Instant()
    assert swept(tmp_path, "episodes=1", "logger=csv", "checkpoint_interval=3") == []
    (tmp_path / "runs" / "by_hand" / "eval.json").unlink()
    swept(tmp_path, "episodes=1", "logger=csv", executor=executor)
    assert executor.tasks[0].run.name == "by_hand"
    assert [*executor.tasks[0].overrides] == ["device=cpu", "logger=csv"]
    assert swept(tmp_path, "episodes=1", "learner.gamma=0.5") == [0]
    assert swept(tmp_path, "episodes=2") == [0]


def test_a_failing_run_does_not_stop_the_others(tmp_path, capsys):
    arguments = ["independent", *SMALL, f"output={tmp_path}", "seed=0,1,2"]
    assert sweep(arguments, Console(width=300), executor=Instant(fails=[0])) == 1
    assert [len(run.metrics()) for run in folders_in(tmp_path)] == [0, 15, 15]
    said = capsys.readouterr().out
    assert "seed=0: emberlink train: no such thing (log: " in said
    assert "compare them with" not in said


def test_ctrl_c_cancels_what_runs_and_starts_nothing_else(tmp_path):
    class Interrupted(Instant):
        def poll(self, handle):
            os.kill(os.getpid(), signal.SIGINT)
            self.poll = super().poll  # once

    executor = Interrupted()
    arguments = ["independent", *SMALL, f"output={tmp_path}", "seed=range(0,5)"]
    assert sweep(arguments, Console(), executor=executor) == 128 + signal.SIGINT
    assert executor.cancelled == [0, 1]
    assert len(executor.tasks) == 2


def states(capsys) -> list[tuple[str, str]]:
    """Returns the states and episodes of the table that was printed."""
    return re.findall(r"seed=\d+\W+(\w+)\W+(\d+/\d+)", capsys.readouterr().out)


def test_a_dry_run_prints_states(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    arguments = ["sweep", "independent", *SMALL, "seed=0,1", f"output={tmp_path}/runs"]
    assert main([*arguments, "--dry-run"]) == 0
    assert states(capsys) == [("new", "0/15")] * 2
    assert not any(tmp_path.iterdir())
    swept(tmp_path, "seed=0", "episodes=1")
    of_all = ["independent", *SMALL, f"output={tmp_path}/runs", "episodes=1", "seed=0,1,2"]
    for run in combinations(of_all)[1:]:
        run.task()
    lock = Lock(folders_in(tmp_path / "runs")[-1].path)
    capsys.readouterr()
    assert main(["sweep", *of_all, "--dry-run"]) == 0
    lock.release()
    assert states(capsys) == [("finished", "1/1"), ("unfinished", "0/1"), ("running", "0/1")]


OWN = """
from test_sweep import Instant
from emberlink.trainers.sweep.executors.local import LocalConfig


class Pool(Instant):
    config_type = LocalConfig

    def __init__(self, config):
        super().__init__()
        self.workers = config.workers
"""


def test_an_executor_of_another_package(tmp_path, monkeypatch):
    for name, text in {
        "pool.py": OWN,
        "pool-1.0.dist-info/METADATA": "Metadata-Version: 2.1\nName: pool\nVersion: 1.0\n",
        "pool-1.0.dist-info/entry_points.txt": "[emberlink.executors]\npool = pool:Pool\n",
        "mine/executor/pool.yaml": "workers: 1\nthreads: null\ngpus: null\n",
    }.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("EMBERLINK_CONFIGS", str(tmp_path / "mine"))
    monkeypatch.setitem(sys.modules, "test_sweep", sys.modules[__name__])
    monkeypatch.delitem(sys.modules, "pool", raising=False)
    arguments = ["independent", *SMALL, f"output={tmp_path}/runs", "seed=0,1", "executor=pool"]
    assert main(["sweep", *arguments, "executor.workers=2"]) == 0
    assert all(run.evaluated() for run in folders_in(tmp_path / "runs"))
    assert make(["executor=pool"]).workers == 1


TRAINED = [*SMALL, "evaluation.scripted=[]", "evaluation.huygens=false", "checkpoint_steps=40"]


@pytest.mark.heavy
def test_a_stopped_sweep_saves_and_the_same_command_completes_it(tmp_path):
    arguments = ["consensus", *TRAINED, "episodes=6", f"output={tmp_path}"]

    def stop() -> None:
        deadline = time.monotonic() + 300
        while time.monotonic() < deadline:
            if any(1 <= len(run.metrics()) < 5 for run in folders_in(tmp_path)):
                os.kill(os.getpid(), signal.SIGINT)
                break
            time.sleep(0.02)

    thread = threading.Thread(target=stop)
    thread.start()
    assert sweep(arguments, Console()) == 130
    thread.join()
    (run,) = folders_in(tmp_path)
    assert 1 <= len(run.metrics()) < 6
    assert run.step() >= 40
    assert sweep(arguments, Console()) == 0
    assert run.evaluated()
    assert len(run.metrics()) == 6


@pytest.mark.heavy
def test_a_killed_sweep_ends_its_trainings(tmp_path):
    (tmp_path / "random.py").write_text("raise RuntimeError('modules here are not imported')\n")
    command = [sys.executable, *["-P", "-m", "emberlink", "sweep", "independent"], *TRAINED]
    process = subprocess.Popen([*command, "episodes=9999", "output=runs"], cwd=tmp_path)
    deadline = time.monotonic() + 300
    while not any(run.metrics() for run in folders_in(tmp_path / "runs")):
        assert time.monotonic() < deadline
        time.sleep(0.1)
    process.kill()
    process.wait()
    (run,) = folders_in(tmp_path / "runs")
    while (run.path / "lock").exists():
        assert time.monotonic() < deadline
        time.sleep(0.1)
    assert "resume with" in (tmp_path / "runs" / "logs" / f"{run.path.name}.txt").read_text()
