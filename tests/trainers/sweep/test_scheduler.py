"""Tests restarts, requeues, full queues and Ctrl-C of sweeps, with executors made for it."""

import io
import multiprocessing
import os
import signal
import threading
import time

import pytest
from rich.console import Console

from emberlink.envs.utils.errors import UserError
from emberlink.trainers.runs.run_folder import RunFolder
from emberlink.trainers.sweep import executors, manifest, question, slots
from emberlink.trainers.sweep.command import sweep
from emberlink.trainers.sweep.jobs import FoundRun, jobs_of
from emberlink.trainers.sweep.leases import TRAINING, Leases
from emberlink.trainers.sweep.progress import SweepProgress
from emberlink.trainers.sweep.worker import HELD

RUN = ["independent", "episodes=1", "evaluation.interval=0"]
PREEMPTED = 128 + signal.SIGUSR2


class Scripted(executors.Executor):
    """Returns given statuses one after another; each is a number or a function of the folder."""

    interval = 0.01

    def __init__(self, *statuses):
        self.statuses, self.submitted = list(statuses), []
        self.cancelled, self.left = [], []

    def slots(self, tasks):
        return 10

    def submit(self, task):
        self.submitted.append(task)
        return task, self.statuses.pop(0)

    def poll(self, handle):
        task, status = handle
        run = RunFolder(task.arguments[0].removeprefix("resume="))
        if task in self.cancelled:
            return 143
        return status(run) if callable(status) else status

    def cancel(self, handle):
        self.cancelled.append(handle[0])

    def leave(self, handle):
        self.left.append(handle[0])


def finishes(run: RunFolder) -> int:
    run.append("metrics.jsonl", {"episode": 1, "coverage": 50.0})
    (run.checkpoints / "step_000000001.safetensors").touch()
    run.write("eval.json", {"checkpoint": "step_000000001.safetensors"})
    return 0


def saves(run: RunFolder) -> int:
    """Writes another state, then reports the preemption."""
    number = len(list(run.checkpoints.glob("state_*"))) + 1
    (run.checkpoints / f"state_{number:09}.safetensors").touch()
    return PREEMPTED


def swept(folder, executor, *more) -> int:
    return sweep([*RUN, f"output={folder}", *more], Console(width=200), executor=executor)


def states(folder) -> list[str]:
    return [row.state for row in manifest.read(folder).values()]


@pytest.mark.parametrize("deaths", [1, 3])
def test_a_run_whose_machine_died_is_started_again(tmp_path, deaths):
    executor = Scripted(*[executors.DIED] * deaths, finishes)
    assert swept(tmp_path, executor) == 0
    assert len(executor.submitted) == deaths + 1
    assert len({task.arguments[0] for task in executor.submitted}) == 1
    assert states(tmp_path) == ["finished"]


def test_a_run_is_started_again_a_bounded_number_of_times(tmp_path, capsys):
    executor = Scripted(*[executors.DIED] * 9)
    assert swept(tmp_path, executor) == 1
    assert len(executor.submitted) == 4
    assert "exit status -9 after 3 restarts" in capsys.readouterr().out
    assert states(tmp_path) == ["failed"]
    # The same command again tries it again.
    assert swept(tmp_path, Scripted(finishes)) == 0


class Retrying(Scripted):
    """Starts a training four times, which dies each time, before it reports that it died."""

    def submit(self, task):
        ((run, token),) = task.leases.items()
        for _ in range(4):
            fork = multiprocessing.get_context("fork")
            process = fork.Process(target=lambda: Leases(task.output).take(run, TRAINING, token))
            process.start()
            process.join()
        return super().submit(task)


def test_restarts_by_the_cluster_are_counted(tmp_path, capsys):
    executor = Retrying(*[executors.DIED] * 9)
    assert swept(tmp_path, executor) == 1
    assert len(executor.submitted) == 1
    assert "exit status -9 after 3 restarts" in capsys.readouterr().out


def test_a_preempted_run_that_has_saved_is_requeued_without_a_bound(tmp_path):
    executor = Scripted(*[saves] * 9, finishes)
    assert swept(tmp_path, executor) == 0
    assert len(executor.submitted) == 10


def test_a_run_that_is_preempted_before_it_saves_is_counted(tmp_path):
    executor = Scripted(*[PREEMPTED] * 9)
    assert swept(tmp_path, executor) == 1
    assert len(executor.submitted) == 4


def test_a_failure_is_not_repeated(tmp_path):
    executor = Scripted(2)
    assert swept(tmp_path, executor) == 1
    assert len(executor.submitted) == 1


def test_a_task_that_found_its_run_held_waits(tmp_path, capsys):
    executor = Scripted(HELD, finishes)
    assert swept(tmp_path, executor) == 0
    assert "waits, another sweep is training it" in capsys.readouterr().out


class Full(Scripted):
    """Accepts two tasks at a time."""

    def __init__(self, accepted, *statuses):
        super().__init__(*statuses)
        self.accepted, self.most = accepted, 0
        self.running = set()

    def submit(self, task):
        if len(self.running) == self.accepted:
            raise executors.QueueFullError("executor=full: no more")
        self.running.add(task.log)
        self.most = max(self.most, len(self.running))
        return super().submit(task)

    def poll(self, handle):
        self.running.discard(handle[0].log)
        return super().poll(handle)


def test_a_full_queue_takes_the_other_runs_later(tmp_path):
    executor = Full(2, *[finishes] * 5)
    assert swept(tmp_path, executor, "seed=range(0,5)") == 0
    assert executor.most == 2
    assert len(executor.submitted) == 5


class Unreachable(Scripted):
    """Refuses the second and third submission, although nothing is full."""

    asked, most, running = 0, 0, 0

    def submit(self, task):
        self.asked += 1
        if self.asked in (2, 3):
            raise executors.QueueFullError("executor=cluster: cannot be reached")
        self.running += 1
        self.most = max(self.most, self.running)
        return super().submit(task)

    def poll(self, handle):
        if self.most < 3 and self.submitted[0] is handle[0]:
            return None
        self.running -= 1
        return super().poll(handle)


def test_a_cluster_that_is_not_reached_for_a_while_gets_all_runs(tmp_path, monkeypatch, capsys):
    """The first task goes on until three run at a time."""
    monkeypatch.setattr(slots, "RETRY", 0.05)
    executor = Unreachable(*[finishes] * 4)
    assert swept(tmp_path, executor, "seed=range(0,4)") == 0
    assert len(executor.submitted) == 4
    assert capsys.readouterr().out.count("executor=cluster: cannot be reached") == 1


class Wrong(Scripted):
    """Reports a wrong setting."""

    def submit(self, task):
        raise UserError("executor=wrong: no such partition")


def test_the_leases_are_free_after_a_wrong_setting(tmp_path):
    for _ in range(2):
        with pytest.raises(UserError, match="no such partition"):
            swept(tmp_path, Wrong())
    (row,) = manifest.read(tmp_path).values()
    assert Leases(tmp_path).newest(row.run).ended == "not started"


def test_a_queue_that_takes_nothing_is_an_error(tmp_path):
    with pytest.raises(UserError, match="executor=full: no more"):
        swept(tmp_path, Full(0), "seed=0,1")


def interrupt_when_submitted(executor) -> None:
    """Sends SIGINT to this process when a training was submitted."""
    deadline = time.monotonic() + 60
    while not executor.submitted and time.monotonic() < deadline:
        time.sleep(0.01)
    if executor.submitted:
        os.kill(os.getpid(), signal.SIGINT)


def interrupted(executor, answer, monkeypatch, folder) -> int:
    """Sends SIGINT to a sweep with a running training and answers the question."""
    answers = [answer]
    monkeypatch.setattr(question, "ask", lambda *_: answers.pop(0))

    thread = threading.Thread(target=interrupt_when_submitted, args=(executor,), daemon=True)
    thread.start()
    try:
        return swept(folder, executor)
    finally:
        thread.join()


def test_ctrl_c_stops_the_trainings(tmp_path, monkeypatch):
    executor = Scripted(None)
    assert interrupted(executor, question.STOP, monkeypatch, tmp_path) == 130
    assert executor.cancelled
    assert states(tmp_path) == ["stopped"]


def test_ctrl_c_leaves_the_trainings_running(tmp_path, monkeypatch, capsys):
    executor = Scripted(None)
    assert interrupted(executor, question.LEAVE, monkeypatch, tmp_path) == 130
    assert executor.left == executor.submitted
    assert not executor.cancelled
    printed = capsys.readouterr().out.replace("\n", " ")
    assert "show their states with: emberlink sweep status" in printed
    # The lease of the sweep is free, for the task and for other sweeps.
    ((run, token),) = executor.submitted[0].leases.items()
    assert Leases(tmp_path).take(run, TRAINING, token) is not None


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize(
    ("may_leave", "answer"), [(True, question.LEAVE), (False, question.CONTINUE)]
)
def test_a_cluster_that_ends_with_the_sweep_cannot_be_left(monkeypatch, may_leave, answer):
    monkeypatch.setattr("sys.stdin", Terminal("what\nl\nc\n"))
    shown = io.StringIO()
    progress = SweepProgress(Console(file=shown, force_terminal=True, width=200), 1, 0)
    assert question.ask(progress, 2, may_leave) == answer
    assert ("[l]eave" in shown.getvalue()) is may_leave
    progress.stop()


@pytest.mark.parametrize("width", [72, 80, 120])
def test_the_progress_shows_whole_names_numbers_and_times(width, tmp_path):
    """Brackets of a name are no markup."""
    swept = 'learner.warm_start=a,"b[/c]"', "evaluation.scripted=[oracle],[courier]"
    first, last = jobs_of(["consensus", "setup=tuned", *swept, f"output={tmp_path}"])[::3]
    first.create_folders()
    (folder,) = (FoundRun(RunFolder(file.parent)) for file in tmp_path.glob("*/config.yaml"))
    first.found = {0: folder}
    lines = ['{"episode": 14, "coverage": 91.24}\n', '{"episode": 15, "coverage": 96.71}\n']
    (folder.folder.path / "metrics.jsonl").write_text("".join([lines[0]] * 14 + lines[1:]))
    shown = io.StringIO()
    with SweepProgress(Console(file=shown, width=width), 4, 1) as progress:
        progress.begin(last)
        progress.follow(first)
    whole = " ".join(shown.getvalue().split())
    for part in ("1/4 runs", "15/15 episodes", "96.7 %, evaluation", "0:00:00"):
        assert part in whole
    lines = shown.getvalue().splitlines()
    names = "".join("".join(line[: lines[0].index("1/4")].split()) for line in lines)
    for text in ('warm_start="b[/c]"', "evaluation.scripted=[courier]", "seed0"):
        assert text in names.replace("━", "")


def test_a_line_without_coverage_is_counted(tmp_path):
    (job,) = jobs_of(["independent", f"output={tmp_path}"])
    job.create_folders()
    (folder,) = (RunFolder(file.parent) for file in tmp_path.glob("*/config.yaml"))
    (folder.path / "metrics.jsonl").write_text('{"episode": 1}\n')
    job.found = {0: FoundRun(folder)}
    shown = io.StringIO()
    with SweepProgress(Console(file=shown, width=80), 1, 0) as progress:
        progress.follow(job)
    assert "1/200 episodes" in " ".join(shown.getvalue().split())


def test_ctrl_c_may_be_taken_back(tmp_path, monkeypatch):
    began = time.monotonic()
    executor = Scripted(lambda run: finishes(run) if time.monotonic() - began > 1 else None)
    assert interrupted(executor, question.CONTINUE, monkeypatch, tmp_path) == 0
    assert not executor.cancelled


def test_without_a_terminal_ctrl_c_stops(tmp_path):
    executor = Scripted(None)
    thread = threading.Thread(target=interrupt_when_submitted, args=(executor,), daemon=True)
    thread.start()
    assert swept(tmp_path, executor) == 130
    assert executor.cancelled


class Cluster(Scripted):
    """Knows a task by its name in a later sweep."""

    def name_of(self, handle):
        return "task 7"

    def find(self, name):
        assert name == "task 7"
        return self.known


def test_a_later_sweep_follows_a_task_that_was_left(tmp_path, monkeypatch):
    first = Cluster(None)
    assert interrupted(first, question.LEAVE, monkeypatch, tmp_path) == 130
    second = Cluster()
    second.known = first.submitted[0], finishes
    assert swept(tmp_path, second) == 0
    assert second.submitted == []
    third = Cluster(finishes)
    third.known = None
    assert swept(tmp_path, third) == 0
    assert third.submitted == []  # it is finished


class Late(Cluster):
    """Gives a task its name when the task has been polled."""

    def name_of(self, handle):
        return "task 7" if self.polled else ""

    polled = False

    def poll(self, handle):
        self.polled = True
        return super().poll(handle)


def test_a_name_that_is_known_later_is_recorded(tmp_path, monkeypatch):
    def leave(*_):
        assert [row.task for row in manifest.read(tmp_path).values()] == ["task 7"]
        return question.LEAVE

    executor = Late(None)

    def interrupt():
        deadline = time.monotonic() + 30
        while not executor.polled and time.monotonic() < deadline:
            time.sleep(0.01)
        time.sleep(0.5)
        os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(question, "ask", leave)
    thread = threading.Thread(target=interrupt)
    thread.start()
    assert swept(tmp_path, executor) == 130
    thread.join()


def test_a_task_that_has_vanished_is_submitted_again(tmp_path, monkeypatch):
    first = Cluster(None)
    interrupted(first, question.LEAVE, monkeypatch, tmp_path)
    second = Cluster(finishes)
    second.known = None
    assert swept(tmp_path, second) == 0
    assert len(second.submitted) == 1


def test_new_seeds_are_stacked_where_asked(tmp_path):
    executor = Scripted(*[lambda run: 2] * 9)
    executor.seeds = 2
    assert swept(tmp_path, executor, "seed=range(0,5)", "setup=paper,tuned") == 1
    stacks = [
        RunFolder(task.arguments[0].removeprefix("resume=")).config().seeds
        for task in executor.submitted
    ]
    assert stacks == [(0, 1), (2, 3), (), (0, 1), (2, 3), ()]
    assert [len(task.leases) for task in executor.submitted] == [2, 2, 1, 2, 2, 1]
