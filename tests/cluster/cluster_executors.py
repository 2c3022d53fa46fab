"""Tests sweeps on submitit, SLURM and Ray, with interruptions; `make test-cluster` runs them.

Each sweep trains 12 runs, whose files must be those of the local executor, byte for byte.
"""

import os
import signal
import subprocess
import threading
from importlib.util import find_spec
from pathlib import Path

import pytest
import sweeps
from rich.console import Console
from slurm import INSTALL, cluster, kill_node, missing, node

from emberlink.trainers.sweep import executors
from emberlink.trainers.sweep.command import sweep
from emberlink.trainers.sweep.executors.submitit import SubmititExecutor

pytestmark = pytest.mark.cluster


@pytest.fixture(scope="session", autouse=True)
def _programs() -> None:
    """Fails if something is not installed: a test that is left out would not be noticed."""
    absent = [name for name in ("submitit", "ray") if find_spec(name) is None]
    if absent:
        pytest.exit(f"{', '.join(absent)}: not installed; pip install '.[slurm,ray]'", 2)
    if missing():
        pytest.exit(f"{', '.join(missing())}: not installed; {INSTALL}", 2)
    if os.geteuid() != 0:
        pytest.exit("SLURM's daemons are started as root", 2)


@pytest.fixture(scope="session")
def local(tmp_path_factory) -> dict[str, dict[str, bytes]]:
    """Returns the results of the local executor."""
    folder = tmp_path_factory.mktemp("local")
    sweeps.finish(sweeps.start(folder), folder)
    return sweeps.results(folder)


class _Watched(SubmititExecutor):
    """Keeps the handles of its tasks."""

    def submit(self, task):
        self.handles = [*getattr(self, "handles", []), super().submit(task)]
        return self.handles[-1]


def test_submitit_requeues_an_interrupted_run(local, tmp_path, monkeypatch):
    """One run gets submitit's signal; the controller of another one is killed."""
    monkeypatch.chdir(tmp_path)
    made = executors.make("submitit", {"cluster": "local", "workers": 2})
    executor = _Watched(made._config)
    trained: list[str] = []

    def interrupt() -> None:
        sweeps.wait_for(lambda: sweeps.training(tmp_path))
        controller = _controller_of(executor, sweeps.training(tmp_path)[0].path.name)
        (task,) = _children(controller._process.pid)
        os.kill(task, signal.SIGUSR2)
        trained.append("requeued")
        sweeps.wait_for(lambda: sweeps.resumed(tmp_path))
        sweeps.wait_for(lambda: sweeps.training(tmp_path))
        # This ends submitit's controller (1.5.4), and the training goes on without it.
        _controller_of(executor, sweeps.training(tmp_path)[-1].path.name)._interrupt()
        trained.append("orphaned")

    thread = threading.Thread(target=interrupt)
    thread.start()
    assert sweep(sweeps.ARGUMENTS, Console(), executor=executor) == 0
    thread.join()
    assert trained == ["requeued", "orphaned"]
    logs = (tmp_path / "runs" / "logs" / "submitit").glob("*.out")
    assert sum(log.read_text().count("Requeued job") for log in logs) == 1
    assert sweeps.results(tmp_path) == local


def _controller_of(executor: _Watched, folder: str):
    """Returns submitit's job of the run in a folder."""
    (job,) = {h.job for h in executor.handles if h.task.arguments[0].endswith(folder)}
    return job


def _children(process: int) -> list[int]:
    listed = Path(f"/proc/{process}/task/{process}/children").read_text()
    return [int(number) for number in listed.split()]


def test_slurm_runs_come_back_after_a_preemption(local, tmp_path):
    """A job of a partition with precedence takes both cores."""
    folder, daemons = tmp_path / "sweep", tmp_path / "slurm"
    folder.mkdir()
    daemons.mkdir()
    with cluster(daemons) as env:
        keys = ("executor=submitit", "executor.partition=low", "executor.time=20")
        process = sweeps.start(folder, *keys, env=env)
        sweeps.wait_for(lambda: len(sweeps.training(folder)) == 2, process)
        command = ["sbatch", "--partition=high", "--ntasks=2", "--output=/dev/null"]
        subprocess.run([*command, "--wrap=sleep 1"], env=env, check=True)
        sweeps.wait_for(lambda: sweeps.resumed(folder), process)
        sweeps.finish(process, folder)
    assert "DUE TO PREEMPTION" in _errors(folder)
    assert sweeps.results(folder) == local


def test_slurm_requeues_a_run_at_the_end_of_its_time_and_when_its_node_dies(tmp_path):
    """The time is two minutes and the notice 50 s, so SLURM interrupts it after 10 to 70 s."""
    folder, daemons = tmp_path / "sweep of läufe", tmp_path / "slurm"
    folder.mkdir()
    daemons.mkdir()
    keys = ("executor=submitit", "executor.time=2", "executor.notice=50", "seed=0")
    with cluster(daemons) as env:
        process = sweeps.start(folder, *keys, "episodes=9999", env=env, methods=["independent"])
        sweeps.wait_for(lambda: sweeps.resumed(folder) == 1, process)
        (run,) = sweeps.runs_in(folder)
        before = len(run.metrics())
        sweeps.wait_for(lambda: len(run.metrics()) > before + 5, process)
        kill_node(daemons)
        listed = ["squeue", "--noheader", "--format=%t"]
        sweeps.wait_for(lambda: subprocess.check_output(listed, env=env) == b"PD\n", process)
        with node(daemons, env):
            seen = sweeps.resumed(folder)
            sweeps.wait_for(lambda: sweeps.resumed(folder) > seen, process)
            process.terminate()
            assert process.wait(sweeps.PATIENCE) == 128 + signal.SIGTERM
    said = "".join(log.read_text() for log in (folder / "runs/logs/submitit").glob("*.out"))
    assert "Requeued job" in said
    episodes = [line["episode"] for line in run.metrics()]
    assert episodes == list(range(1, len(episodes) + 1))
    assert len(episodes) >= before


def test_slurm_runs_come_back_after_a_signal(local, tmp_path):
    """SLURM's notice arrives in the middle; the sweep is killed; another executor does the rest."""
    folder, daemons = tmp_path / "sweep", tmp_path / "slurm"
    folder.mkdir()
    daemons.mkdir()
    with cluster(daemons) as env:
        process = sweeps.start(folder, "executor=submitit", "executor.share=2", env=env)
        sweeps.wait_for(lambda: len(sweeps.training(folder)) == 2, process)
        subprocess.run(["scancel", "--signal=USR2", "1"], env=env, check=True)
        sweeps.wait_for(lambda: sweeps.resumed(folder), process)
        jobs = sorted((folder / "runs/logs/submitit").glob("*_submitted.pkl"))
        process.kill()
        process.wait()
        said = sweeps.finished(folder)
        process = sweeps.start(folder, "executor=submitit", "executor.share=2", env=env)
        sweeps.wait_for(lambda: sweeps.finished(folder) > said + 1, process)
        process.terminate()
        assert process.wait(sweeps.PATIENCE) == 128 + signal.SIGTERM
        assert subprocess.check_output(["squeue", "--noheader"], env=env) == b""
    # The second sweep has followed the jobs of the first.
    assert jobs == sorted((folder / "runs/logs/submitit").glob("*_submitted.pkl"))
    done = [run for run in sweeps.runs_in(folder) if run.evaluated()]
    before = {run.path: (run.path / "eval.json").stat().st_mtime_ns for run in done}
    sweeps.finish(sweeps.start(folder), folder)
    assert before == {path: (path / "eval.json").stat().st_mtime_ns for path in before}
    assert sweeps.results(folder) == local


def _errors(folder: Path) -> str:
    return "".join(log.read_text() for log in (folder / "runs/logs/submitit").glob("*.err"))


def test_ray_runs_go_on_after_a_node_was_killed(local, tmp_path):
    import psutil
    from ray.cluster_utils import Cluster

    nodes = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    others = [nodes.add_node(num_cpus=1) for _ in range(2)]
    nodes.wait_for_nodes()
    try:
        keys = ("executor=ray", f"executor.address={nodes.address}")
        process = sweeps.start(tmp_path, *keys)
        sweeps.wait_for(lambda: len(sweeps.training(tmp_path)) == 3, process)
        raylet = others[0].all_processes["raylet"][0].process.pid
        victims = psutil.Process(raylet).children(recursive=True)
        for victim in victims:
            victim.kill()
        nodes.remove_node(others[0], allow_graceful=False)
        sweeps.finish(process, tmp_path)
    finally:
        nodes.shutdown()
    assert sweeps.resumed(tmp_path) >= 1
    assert sweeps.results(tmp_path) == local
