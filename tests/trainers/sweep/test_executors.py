"""Tests the keys of executors, missing packages, and trainings that outlive their sweep."""

import os
import pty
import re
import signal
import socket
import subprocess
import sys
import time
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import pytest
from tiny_run import TINY

from emberlink.envs.utils.errors import UserError
from emberlink.trainers.cli.main import main
from emberlink.trainers.runs.run_folder import RunFolder
from emberlink.trainers.sweep import executors
from emberlink.trainers.sweep.executors import Task, _extras, _process, local, submitit
from emberlink.trainers.sweep.executors._times import minutes


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("90", 90),
        ("90:00", 90),
        ("90:30", 91),
        ("4:00:00", 240),
        ("0:00:01", 1),
        ("1-0", 1440),
        ("1-12", 2160),
        ("2-3:04", 3064),
        ("2-3:04:05", 3065),
    ],
)
def test_times_have_the_forms_of_sbatch(text, expected):
    assert minutes(text) == expected


@pytest.mark.parametrize("text", ["0", "0:00", "0-0", "-5", "1.5", "1:2:3:4", "1-", "", "None"])
def test_other_times_are_errors(text):
    with pytest.raises(UserError, match="expected minutes"):
        minutes(text)


def test_settings_that_are_texts_keep_their_form(monkeypatch):
    monkeypatch.setattr(_extras, "find_spec", lambda _: True)
    texts = {"account": "007", "partition": "12", "memory": "4000", "time": "4:00:00", "cpus": "2"}
    config = executors.from_texts("submitit", texts)._config
    assert (config.account, config.partition, config.memory) == ("007", "12", "4000")
    assert (config.time, config.cpus) == ("4:00:00", 2)
    config = executors.from_texts("submitit", {"partition": "null", "account": ""})._config
    assert (config.partition, config.account, config.time) == (None, None, "60")


@pytest.fixture
def nothing_installed(monkeypatch):
    monkeypatch.setattr(_extras, "find_spec", lambda _: None)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        (
            "submitit",
            "submitit is not installed: pip install '.[slurm]' in the folder of emberlink",
        ),
        ("ray", "ray is not installed: pip install '.[ray]' in the folder of emberlink"),
    ],
)
def test_a_missing_package_is_named_in_one_line(
    name, said, nothing_installed, tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    assert main(["sweep", "independent", f"executor={name}"]) == 2
    error = capsys.readouterr().err
    assert error == f"emberlink sweep: executor={name}: {said}\n"
    assert not any(tmp_path.iterdir())


def test_a_machine_without_slurm_is_named(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(_extras, "find_spec", lambda _: True)
    monkeypatch.setenv("PATH", "")
    assert main(["sweep", "independent", "executor=submitit"]) == 2
    assert "there is no sbatch here" in capsys.readouterr().err
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["executor=submitit", "executor.time=soon"], "executor.time=soon"),
        (["executor=submitit", "executor.time=4:00:00:00"], "executor.time=4:00:00:00"),
        (["executor=submitit", "executor.cluster=debug"], "executor.cluster=debug"),
        (["executor=submitit", "executor.address=auto"], "'executor.address' is not known"),
        (["executor=submitit", "executor.time=null"], "executor.time=null: expected minutes"),
        (["executor=submitit", "executor.time=2"], "executor.notice=90: executor.time=2 must be"),
        (["executor=submitit", "executor.options={qos: low"], "executor.options={qos: low"),
        (["executor=submitit", "executor.options={qos: [1]}"], "options.qos=[1]: expected text"),
        (["executor=ray", "executor.gpus=-1"], "executor.gpus=-1"),
        (["executor=ray", "executor.gpus=1.5"], "executor.gpus=1.5: expected a fraction of 1 or"),
        (["executor=ray", "executor.gpus=.nan"], "executor.gpus=nan"),
        (["executor=ray", "executor.resources={a: 2.5}"], "executor.resources.a=2.5: expected a"),
        (["executor=ray", "executor.resources={a: 0}"], "executor.resources"),
        (["executor.seeds=0"], "executor.seeds=0"),
        (["executor.restarts=-1"], "executor.restarts=-1"),
    ],
)
def test_wrong_keys_are_named_in_one_line(arguments, said, tmp_path, capsys, monkeypatch):
    """The keys are checked before the packages."""
    monkeypatch.chdir(tmp_path)
    assert main(["sweep", "independent", *arguments]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"cpus": 3}, "no node has CPU=3"),
        ({"cpus": 2, "gpus": 0.5}, "no node has CPU=2, GPU=0.5"),
        ({"resources": {"big": 1}}, "no node has CPU=1, big=1"),
        ({"memory": 3 * 10**9}, "no node has CPU=1, memory=3e"),
        ({"cpus": 2}, ""),
        ({"gpus": 0.5}, ""),
    ],
)
def test_runs_that_no_node_can_take_are_told(settings, said, monkeypatch):
    monkeypatch.setattr(_extras, "find_spec", lambda _: True)
    nodes = [
        {"Alive": True, "Resources": {"CPU": 2.0, "memory": 2e9}},
        {"Alive": True, "Resources": {"CPU": 1.0, "GPU": 1.0}},
        {"Alive": False, "Resources": {"CPU": 64.0, "GPU": 8.0, "memory": 1e12, "big": 1}},
    ]
    monkeypatch.setattr(_extras, "load", lambda _: SimpleNamespace(nodes=lambda: nodes))
    executor = executors.make("ray", settings)
    with pytest.warns(UserWarning, match=said) if said else nullcontext():
        executor._check_nodes()


@pytest.mark.parametrize("address", ["127.0.0.1:1", "ray://127.0.0.1:1", "[::1]:1", "h:99999999"])
def test_an_address_without_a_cluster_is_named_in_one_line(address, monkeypatch):
    monkeypatch.setattr(_extras, "find_spec", lambda _: True)
    executor = executors.make("ray", {"address": address})
    with pytest.raises(UserError, match=re.escape(f"executor.address={address}: ")):
        executor._check_address()


@pytest.mark.parametrize(("address", "told"), [("127.0.0.1:1", True), ("auto", False)])
def test_a_cluster_that_refuses_may_ask_for_a_token(address, told, monkeypatch):
    def init(*_, **__):
        raise ConnectionError("refused")

    fake = SimpleNamespace(is_initialized=lambda: False, init=init)
    monkeypatch.setattr(_extras, "find_spec", lambda _: True)
    monkeypatch.setattr(_extras, "load", lambda _: fake)
    executor = executors.make("ray", {"address": address})
    monkeypatch.setattr(executor, "_check_address", lambda: None)
    with pytest.raises(UserError, match="refused") as caught:
        executor._connect()
    assert ("RAY_AUTH_MODE=token" in str(caught.value)) == told


def test_an_address_that_answers_is_tried(monkeypatch):
    monkeypatch.setattr(_extras, "find_spec", lambda _: True)
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"127.0.0.1:{server.getsockname()[1]}"
        executors.make("ray", {"address": address})._check_address()
    for address in ("auto", "local"):
        executors.make("ray", {"address": address})._check_address()


class Sbatch:
    """Stands for submitit's executor; refuses jobs while `refuses` is a message."""

    refuses = ""

    def __init__(self):
        self.jobs: list[int] = []

    def submit(self, batch):
        print("sbatch: error: printed by submitit", file=sys.stderr)
        if self.refuses:
            raise RuntimeError(self.refuses)
        self.jobs.append(len(batch._tasks))
        return SimpleNamespace(job_id=str(len(self.jobs)))


@pytest.fixture
def slurm(monkeypatch, tmp_path):
    """An executor with two runs of a job, and what stands for sbatch."""
    monkeypatch.setattr(_extras, "find_spec", lambda _: True)
    executor, sbatch = executors.make("submitit", {"share": 2, "partition": "nope"}), Sbatch()
    monkeypatch.setattr(executor, "_make", lambda folder: sbatch)
    listed = "1 Priority\n2 Resources\n3 PartitionTimeLimit\n"
    monkeypatch.setattr(submitit, "_slurm", lambda *command: listed)
    return executor, sbatch, [Task([], tmp_path / f"{n}.txt", output=tmp_path) for n in range(6)]


def test_a_job_that_slurm_never_takes_is_one_line_with_the_settings(slurm, capsys):
    executor, sbatch, tasks = slurm
    sbatch.refuses = "sbatch: error: invalid partition: nope\nsbatch: error: failed: Invalid name"
    handle = executor.submit(tasks[0])
    with pytest.raises(UserError) as error:
        executor.submit(tasks[1])
    assert not isinstance(error.value, executors.QueueFullError)
    assert str(error.value) == (
        "executor=submitit executor.partition=nope executor.time=60 executor.cpus=1: "
        "invalid partition: nope; failed: Invalid name"
    )
    assert capsys.readouterr().err == ""
    assert executor.poll(handle) is None


def test_tasks_that_slurm_refuses_are_submitted_later(slurm, monkeypatch):
    executor, sbatch, tasks = slurm
    first = [executor.submit(task) for task in tasks[:2]]
    sbatch.refuses = "Job violates accounting/QOS policy"
    handle = executor.submit(tasks[2])
    with pytest.raises(executors.QueueFullError):
        executor.submit(tasks[3])
    assert [executor.poll(one) for one in (*first, handle)] == [None] * 3
    sbatch.refuses = ""
    assert executor.poll(handle) is None
    assert sbatch.jobs == [2]
    monkeypatch.setattr(submitit, "_RETRY", 0.0)
    executor.poll(handle)
    assert sbatch.jobs == [2, 1]
    assert handle.job.job_id == "2"


def test_a_job_of_a_moved_folder_is_not_followed(slurm, tmp_path, monkeypatch):
    """Its number may be that of another job."""
    executor, _, tasks = slurm
    jobs = SimpleNamespace(SlurmJob=lambda **about: SimpleNamespace(**about))
    monkeypatch.setattr(_extras, "load", lambda name: jobs)
    assert executor.find(f"1 {tmp_path / 'moved' / '0.txt'}") is None
    assert executor.find(f"7 {tasks[0].log}") is None


def test_an_unusual_reason_for_which_jobs_wait_is_told_once(slurm):
    executor, _, tasks = slurm
    handles = [executor.submit(task) for task in tasks]
    with pytest.warns(UserWarning, match="PartitionTimeLimit .*executor.time=60") as said:
        assert [executor.poll(handle) for handle in handles] == [None] * 6
    assert len(said) == 1


def test_a_job_that_ends_before_its_training_is_explained(slurm, tmp_path, monkeypatch):
    executor, _, tasks = slurm
    handle, _ = executor.submit(tasks[0]), executor.submit(tasks[1])
    (tmp_path / "1.err").write_text("srun: error\nModuleNotFoundError: No module\n\n")
    handle.job = SimpleNamespace(job_id="9", paths=SimpleNamespace(stderr=tmp_path / "1.err"))
    handle.seen -= 100
    assert executor.poll(handle) == executors.DIED
    said = tasks[0].log.read_text()
    assert "ModuleNotFoundError: No module" in said
    assert str(tmp_path / "1.err") in said


def test_importing_an_executor_imports_no_package_of_an_extra():
    code = "import sys; from emberlink.trainers.sweep.executors import ray, submitit;"
    code += "print({'ray', 'submitit', 'torch'} & {*sys.modules})"
    assert subprocess.check_output([sys.executable, "-c", code], text=True) == "set()\n"


class Started:
    """Stands for a process that runs until a test ends it."""

    def __init__(self):
        self.status = None

    def poll(self):
        return self.status


def test_gpus_are_shared_in_turn(monkeypatch, tmp_path):
    given: list[int | None] = []

    def start(task, threads, gpu=None):
        given.append(gpu)
        return Started()

    monkeypatch.setattr(local._process, "start", start)
    executor = executors.make("local", {"workers": 4, "gpus": 2})
    handles = [executor.submit(Task([], tmp_path / "log")) for _ in range(4)]
    assert given == [0, 1, 0, 1]
    handles[1].status = 0
    executor.submit(Task([], tmp_path / "log"))
    assert given[-1] == 1


def test_a_process_sees_its_share_of_threads_and_gpus(monkeypatch, tmp_path):
    code = "import os; print(os.environ['OMP_NUM_THREADS'], os.environ['CUDA_VISIBLE_DEVICES'])"
    monkeypatch.setattr(Task, "command", [sys.executable, "-c", code])
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "4,7")
    _process.start(Task([], tmp_path / "log"), threads=3, gpu=1).wait()
    assert (tmp_path / "log").read_text() == "3 7\n"


LONG = [*(word for word in TINY if word != "episodes=2"), "episodes=4000", "checkpoint_steps=50"]


@pytest.mark.heavy
def test_ctrl_c_at_a_terminal_leaves_a_local_training_running(tmp_path):
    """`sweep status` sees it, the same sweep waits for it, and SIGTERM saves it."""
    sweep = [sys.executable, "-m", "emberlink.trainers.cli", "sweep"]
    terminal, end = pty.openpty()
    process = subprocess.Popen(
        [*sweep, "independent", *LONG, f"output={tmp_path}"],
        stdin=end,
        stdout=end,
        stderr=end,
        start_new_session=True,
        env={**os.environ, "TERM": "xterm"},
    )
    os.close(end)
    wait_for(lambda: any(run.lines() for run in runs_in(tmp_path)), terminal)
    process.send_signal(signal.SIGINT)
    wait_for(lambda: b"[l]eave" in read.output, terminal)
    os.write(terminal, b"what\nl\n")
    wait_for(lambda: process.poll() is not None, terminal)
    assert process.returncode == 130
    assert b"sweep status" in read.output
    (run,) = runs_in(tmp_path)
    done = len(run.lines())
    time.sleep(1)
    wait_for(lambda: len(run.lines()) > done + 1)
    said = subprocess.check_output([*sweep, "status", tmp_path], text=True)
    assert "running" in said
    holder = int(said.split("process ")[1].split()[0])
    os.kill(holder, signal.SIGTERM)
    wait_for(lambda: run.states())
    wait_for(lambda: not Path(f"/proc/{holder}").exists() or zombie(holder))
    assert "stopped" in subprocess.check_output([*sweep, "status", tmp_path], text=True)


def runs_in(folder) -> list[RunFolder]:
    return [RunFolder(file.parent) for file in folder.glob("*/config.yaml")]


def zombie(process: int) -> bool:
    return Path(f"/proc/{process}/stat").read_text().split()[2] == "Z"


def read(terminal: int) -> None:
    """Reads what a terminal shows."""
    os.set_blocking(terminal, False)
    try:
        read.output += os.read(terminal, 1 << 16)
    except OSError:
        return


read.output = b""


def wait_for(condition, terminal: int | None = None) -> None:
    deadline = time.monotonic() + 120
    while not condition():
        assert time.monotonic() < deadline, read.output
        if terminal is not None:
            read(terminal)
        time.sleep(0.1)
    if terminal is not None:
        read(terminal)
