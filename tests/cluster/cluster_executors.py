"""Tests sweeps on submitit, SLURM and Ray, with interruptions; `make test-cluster` runs them.

Each sweep trains three runs, whose files must equal the local executor's byte for byte.
"""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import pytest
from slurm import INSTALL, cluster, missing

from emberlink.trainers.runs.run_folder import RunFolder

pytestmark = pytest.mark.cluster
COMMAND = [
    *(sys.executable, "-m", "emberlink", "sweep", "consensus", "seed=0,1,2"),
    *("output=runs", "episodes=40", "env.horizon=15", "env.num_uavs=2", "num_envs=2"),
    *("learner.hidden=[8,8]", "learner.batch_size=8", "checkpoint_steps=30"),
    *("evaluation.episodes=2", "evaluation.interval=0", "evaluation.scripted=[]"),
    *("evaluation.huygens=false", "fire.num_train_fires=2"),
]
PATIENCE = 900.0


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


def start(folder: Path, *more: str, env: dict[str, str] | None = None) -> subprocess.Popen:
    """Starts the sweep in a folder with a random.py, which nothing may import."""
    (folder / "random.py").write_text("raise RuntimeError('wrong module')\n")
    with (folder / "out.txt").open("ab") as out, (folder / "err.txt").open("ab") as err:
        # -P: the sweep itself is started as the installed command is.
        command = [COMMAND[0], "-P", *COMMAND[1:], *more]
        return subprocess.Popen(command, cwd=folder, env=env, stdout=out, stderr=err)


def finish(process: subprocess.Popen, folder: Path) -> None:
    """Waits for a sweep, which must succeed and print nothing to standard error."""
    assert process.wait(PATIENCE) == 0, (folder / "out.txt").read_text()
    assert (folder / "err.txt").read_text() == ""


def runs_in(folder: Path) -> list[RunFolder]:
    return [RunFolder(file.parent) for file in sorted(folder.glob("runs/*/config.yaml"))]


def training(folder: Path) -> int:
    """Returns the number of runs that have a checkpoint and are not near their end."""
    return sum(4 <= len(run.metrics()) <= 30 for run in runs_in(folder))


def resumed(folder: Path) -> int:
    """Returns how often a training was resumed in its middle."""
    logs = folder.glob("runs/logs/*.txt")
    return sum(log.read_text().count("resumed at step") for log in logs)


def wait_for(condition: Callable[[], object], process: subprocess.Popen) -> None:
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline
        assert process.poll() is None, "the sweep has ended"
        time.sleep(0.1)


def results(folder: Path) -> dict[str, bytes]:
    """Returns the files that must not depend on where and how often a run was started."""
    files = [run.path / name for run in runs_in(folder) for name in ("metrics.jsonl", "eval.json")]
    files += [run.newest for run in runs_in(folder)]
    return {str(file.relative_to(folder)): file.read_bytes() for file in files}


@pytest.fixture(scope="session")
def local(tmp_path_factory) -> dict[str, bytes]:
    """Returns the results of the local executor."""
    folder = tmp_path_factory.mktemp("local")
    finish(start(folder, "executor.threads=1"), folder)
    assert len(runs_in(folder)) == 3
    return results(folder)


@pytest.fixture
def slurm(tmp_path):
    (tmp_path / "slurm").mkdir()
    with cluster(tmp_path / "slurm") as env:
        yield env


def test_slurm_requeues_runs_that_are_preempted_or_whose_time_ends(local, tmp_path, slurm):
    """A job of a partition with precedence takes both cores; later a run is asked to save."""
    process = start(
        tmp_path, "executor=submitit", "executor.partition=low", "executor.time=20", env=slurm
    )
    wait_for(lambda: training(tmp_path) == 2, process)
    command = ["sbatch", "--partition=high", "--ntasks=2", "--output=/dev/null"]
    subprocess.run([*command, "--wrap=sleep 1"], env=slurm, check=True)
    wait_for(lambda: resumed(tmp_path), process)
    before = resumed(tmp_path)
    wait_for(lambda: training(tmp_path), process)
    # As at the end of the time. The status is not 0 if one of the jobs is just ending.
    subprocess.run(["scancel", "--signal=USR2", "--me"], env=slurm, check=False)
    wait_for(lambda: resumed(tmp_path) > before, process)
    finish(process, tmp_path)
    said = [log.read_text() for log in (tmp_path / "runs/logs/submitit").glob("*.err")]
    assert any("DUE TO PREEMPTION" in text for text in said)
    assert results(tmp_path) == local


def test_a_stopped_sweep_on_slurm_saves_and_is_completed_elsewhere(local, tmp_path, slurm):
    process = start(tmp_path, "executor=submitit", env=slurm)
    wait_for(lambda: training(tmp_path) == 2, process)
    process.send_signal(signal.SIGINT)
    assert process.wait(PATIENCE) == 128 + signal.SIGINT
    assert subprocess.check_output(["squeue", "--noheader"], env=slurm) == b""
    finish(start(tmp_path, "executor.threads=1"), tmp_path)
    assert resumed(tmp_path) == 2
    assert results(tmp_path) == local


def test_ray_starts_a_run_again_when_its_node_dies(local, tmp_path):
    import psutil
    from ray.cluster_utils import Cluster

    nodes = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    other = nodes.add_node(num_cpus=1)
    nodes.wait_for_nodes()
    try:
        process = start(tmp_path, "executor=ray", f"executor.address={nodes.address}")
        wait_for(lambda: training(tmp_path) == 2, process)
        raylet = other.all_processes["raylet"][0].process.pid
        for victim in psutil.Process(raylet).children(recursive=True):
            victim.kill()
        nodes.remove_node(other, allow_graceful=False)
        finish(process, tmp_path)
    finally:
        nodes.shutdown()
    assert resumed(tmp_path) >= 1
    assert results(tmp_path) == local
