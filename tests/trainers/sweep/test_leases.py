"""Tests leases: one of several processes gets a run; a dead or silent process loses it."""

import errno
import json
import multiprocessing
import os
import signal
import time
from dataclasses import replace
from pathlib import Path

import pytest

from emberlink.envs.utils.errors import UserError
from emberlink.trainers.runs.lock import Lock
from emberlink.trainers.sweep import leases, worker
from emberlink.trainers.sweep.leases import PATIENCE, SWEEP, TRAINING, Heart, Leases

FORK = multiprocessing.get_context("fork")


class Clock:
    """A clock that a test sets."""

    def __init__(self, monkeypatch):
        self.now = 1000.0
        monkeypatch.setattr(leases.time, "monotonic", lambda: self.now)


@pytest.fixture
def clock(monkeypatch):
    return Clock(monkeypatch)


def elsewhere(lease: leases.Lease) -> leases.Lease:
    """Rewrites a lease as if its holder were on another machine."""
    lease._write(replace(lease.record, host="other", system="another boot", process=1))
    return lease


def take_many(folder, names, won, no_links) -> None:
    if no_links:

        def refuse(*_):
            raise OSError(errno.EPERM, "no links")

        os.link = refuse
    for name in names:
        lease = Leases(folder).take(name, TRAINING)
        if lease is not None:
            won.put((name, lease.record.token))
    won.put(None)
    time.sleep(30)  # a holder that has ended loses its lease


@pytest.mark.parametrize("no_links", [False, True])
def test_one_of_several_processes_gets_each_run(tmp_path, no_links):
    names, won = [f"{number:02}" for number in range(40)], FORK.Queue()
    processes = [
        FORK.Process(target=take_many, args=(tmp_path, names, won, no_links)) for _ in range(6)
    ]
    for process in processes:
        process.start()
    taken, ended = [], 0
    while ended < len(processes):
        item = won.get(timeout=60)
        ended += item is None
        taken += [item] if item else []
    assert sorted(name for name, _ in taken) == names
    for name, token in taken:
        assert Leases(tmp_path).newest(name).token == token
    for process in processes:
        process.kill()
        process.join()


def test_a_released_run_is_free(tmp_path):
    lease = Leases(tmp_path).take("a", SWEEP)
    assert Leases(tmp_path).take("a", SWEEP) is None
    lease.release("finished")
    assert Leases(tmp_path).take("a", SWEEP) is not None


def test_a_dead_process_of_this_machine_loses_its_run_at_once(tmp_path):
    process = FORK.Process(target=lambda: Leases(tmp_path).take("a", TRAINING))
    process.start()
    process.join()
    observer = Leases(tmp_path)
    assert observer.newest("a").ended == ""
    assert observer.take("a", SWEEP) is not None


def test_a_holder_elsewhere_loses_its_run_after_a_silence(tmp_path, clock):
    elsewhere(Leases(tmp_path).take("a", TRAINING))
    observer = Leases(tmp_path)
    assert observer.take("a", SWEEP) is None
    clock.now += PATIENCE - 1
    assert observer.take("a", SWEEP) is None
    clock.now += 1
    assert observer.take("a", SWEEP) is not None


def test_a_sign_of_life_keeps_a_run(tmp_path, clock):
    lease, observer = elsewhere(Leases(tmp_path).take("a", TRAINING)), Leases(tmp_path)
    for _ in range(5):
        assert observer.take("a", SWEEP) is None
        clock.now += PATIENCE - 1
        assert lease.beat()
    assert observer.take("a", SWEEP) is None


def test_an_observer_that_looks_for_the_first_time_waits(tmp_path, clock):
    """No clock of another machine is used, such as the time of a file."""
    lease = elsewhere(Leases(tmp_path).take("a", TRAINING))
    os.utime(lease.path, (0, 0))
    assert Leases(tmp_path).take("a", SWEEP) is None


def test_a_holder_notices_that_it_lost_its_run(tmp_path, clock):
    lease, observer = elsewhere(Leases(tmp_path).take("a", TRAINING)), Leases(tmp_path)
    assert observer.take("a", SWEEP) is None
    clock.now += PATIENCE
    new = observer.take("a", SWEEP)
    assert not lease.beat()
    lease.release("finished")
    assert Leases(tmp_path).newest("a") == new.record


@pytest.mark.parametrize("place", [(leases, "write_bytes"), (Path, "exists")])
def test_a_holder_without_a_file_system_gives_up_before_others_take_its_run(
    place, tmp_path, clock, monkeypatch
):
    lease = Leases(tmp_path).take("a", TRAINING)

    def fail(*_, **__):
        raise OSError(errno.ESTALE, "stale")

    monkeypatch.setattr(*place, fail)
    lease.release("finished")  # it expires
    clock.now += PATIENCE / 2 - 1
    assert lease.beat()
    clock.now += 1
    assert not lease.beat()


def test_a_sweep_hands_its_lease_to_its_task(tmp_path):
    sweep = Leases(tmp_path).take("a", SWEEP)
    assert Leases(tmp_path).take("a", TRAINING, "another token") is None
    training = Leases(tmp_path).take("a", TRAINING, sweep.record.token)
    assert training is not None
    assert not sweep.beat()
    # The same task again, such as a job that SLURM started twice:
    assert Leases(tmp_path).take("a", TRAINING, sweep.record.token) is None


def test_all_runs_of_a_stack_or_none(tmp_path):
    held = Leases(tmp_path).take("b", SWEEP)
    assert Leases(tmp_path).take_all(["c", "a", "b"], SWEEP) is None
    held.release("finished")
    assert len(Leases(tmp_path).take_all(["c", "a", "b"], SWEEP)) == 3


def test_trainings_that_did_not_release_their_lease_are_counted(tmp_path):
    sweep = Leases(tmp_path).take("a", SWEEP)
    token = sweep.record.token
    tokens = {"a": token}
    for _ in range(3):
        process = FORK.Process(target=lambda: Leases(tmp_path).take("a", TRAINING, token))
        process.start()
        process.join()
    (saved,) = Leases(tmp_path).take_all(tokens, TRAINING, tokens)
    saved.release("exit status 143")
    folder = Leases(tmp_path)
    assert folder.take("a", TRAINING, token) is not None
    assert folder.deaths("a", token) == 3


def task(folder, token, restarts=3) -> dict:
    return {"output": str(folder), "leases": {"a": token}, "restarts": restarts}


def test_a_task_is_not_started_too_often(tmp_path, capsys):
    token = Leases(tmp_path).take("a", SWEEP).record.token
    for _ in range(2):
        process = FORK.Process(target=lambda: Leases(tmp_path).take("a", TRAINING, token))
        process.start()
        process.join()
    assert worker._take(task(tmp_path, token, restarts=1)) == worker.DIED_TOO_OFTEN
    assert "2 trainings of this run ended without saving" in capsys.readouterr().out
    assert isinstance(worker._take(task(tmp_path, token, restarts=2)), list)


def test_a_task_whose_run_is_held_ends(tmp_path, clock, monkeypatch, capsys):
    holder = Leases(tmp_path).take("a", TRAINING)

    def sleep(seconds):
        clock.now += seconds
        holder.beat()

    monkeypatch.setattr(leases.time, "sleep", sleep)
    assert worker._take(task(tmp_path, "of an earlier sweep")) == worker.HELD
    assert "another process is training this run" in capsys.readouterr().out


@pytest.mark.parametrize("wakes", [True, False])
def test_a_task_waits_for_a_suspended_holder_to_leave_the_folder(
    tmp_path, clock, monkeypatch, capsys, wakes
):
    folder = tmp_path / "run"
    folder.mkdir()
    held, slept = Lock(folder), []

    def sleep(seconds):
        clock.now += seconds
        slept.append(seconds)
        if wakes and len(slept) == 3:
            held.release()

    monkeypatch.setattr(leases.time, "sleep", sleep)
    assert worker._wait_for_folders([f"resume={folder}", "device=cpu"]) is wakes
    assert ("is training here" in capsys.readouterr().out) is not wakes
    assert wakes or sum(slept) > PATIENCE
    held.release()


def test_the_heart_writes_signs_of_life_and_reports_a_loss(tmp_path, monkeypatch):
    monkeypatch.setattr(leases, "BEAT", 0.01)
    lost = []
    heart = Heart(lost.append)
    kept, other = Leases(tmp_path).take("a", TRAINING), Leases(tmp_path).take("b", TRAINING)
    heart.add([kept, other])
    heart.start()
    new = Leases(tmp_path).take("b", SWEEP, other.record.token)
    deadline = time.monotonic() + 30
    while not lost or Leases(tmp_path).newest("a").beat < 3:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    assert lost == [other]
    heart.release([kept], "finished")
    heart.close()
    assert Leases(tmp_path).newest("a").ended == "finished"
    assert Leases(tmp_path).newest("b") == new.record


def test_a_training_that_lost_its_run_is_killed(tmp_path):
    lease = Leases(tmp_path).take("a", TRAINING)
    process = FORK.Process(target=lambda: worker._lost(lease))
    process.start()
    process.join()
    assert process.exitcode == -signal.SIGKILL


def test_a_damaged_lease_is_named(tmp_path):
    lease = Leases(tmp_path).take("a", TRAINING)
    for content in ("?", "[]", json.dumps({"token": "x"})):
        lease.path.write_text(content)
        with pytest.raises(ValueError, match=r"a\.1: not a lease"):
            Leases(tmp_path).newest("a")


def test_a_lease_that_was_never_written_expires(tmp_path, clock):
    """On a file system without hard links, a process may be killed after it reserved the name."""
    Leases(tmp_path).take("a", TRAINING).path.write_text("")
    observer = Leases(tmp_path)
    assert observer.take("a", SWEEP) is None
    clock.now += PATIENCE
    assert observer.take("a", SWEEP) is not None


def test_nothing_is_written_through_links(tmp_path):
    outside = tmp_path / "outside"
    outside.mkdir()
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "logs").symlink_to(outside)
    with pytest.raises(ValueError, match="link"):
        Leases(tmp_path / "runs").take("a", SWEEP)
    assert not any(outside.iterdir())


@pytest.mark.parametrize(
    "change", [{"role": "x"}, {"role": [1]}, {"process": "../1"}, {"beat": 1.5}, {"token": 3}]
)
def test_a_lease_with_a_wrong_value_is_named(change, tmp_path):
    lease = Leases(tmp_path).take("run", TRAINING)
    lease.path.write_text(json.dumps(json.loads(lease.path.read_text()) | change))
    with pytest.raises(ValueError, match=f"not a lease: {next(iter(change))}="):
        Leases(tmp_path).newest("run")


def test_a_lease_that_cannot_be_looked_up_cannot_be_taken(tmp_path):
    name = "r" * 300  # too long for a file system: Path.exists raises OSError
    found = Leases(tmp_path)
    assert found.take("run", TRAINING)  # makes the folder of leases
    assert found.newest(name) is None
    with pytest.raises(UserError, match="File name too long"):
        found.take(name, TRAINING)
