"""Tests signals that end a training: which save, and which end it at once."""

import os
import signal

import pytest
from tiny_run import TINY

from emberlink.trainers import train
from emberlink.trainers.cli.main import main
from emberlink.trainers.runs.run_folder import RunFolder
from emberlink.trainers.terminal.signals import Interruption
from emberlink.trainers.training.trainer import Progress, Trainer

INT, TERM, HUP = signal.SIGINT, signal.SIGTERM, signal.SIGHUP
USR1, USR2 = signal.SIGUSR1, signal.SIGUSR2


@pytest.fixture(autouse=True)
def _no_nohup():
    """Undoes `nohup`, under which SIGHUP is ignored."""
    before = signal.signal(HUP, signal.SIG_DFL)
    yield
    signal.signal(HUP, before)


def send(*numbers) -> Interruption:
    """Sends signals to a waiting training and returns the received ones."""
    interruption = Interruption(lambda: None)
    with interruption:
        for number in numbers:
            os.kill(os.getpid(), number)
    return interruption


@pytest.mark.parametrize("numbers", [(TERM,), (USR1, USR1), (USR2, TERM, USR2), (HUP, TERM)])
def test_signals_that_a_cluster_sends_together_let_the_training_save(numbers):
    interruption = send(*numbers)
    assert interruption.received == numbers[0]
    assert interruption.status == 128 + numbers[0]


@pytest.mark.parametrize("numbers", [(INT, INT), (TERM, INT), (USR2, INT)])
def test_a_second_signal_of_the_user_ends_at_once(numbers):
    with pytest.raises(KeyboardInterrupt):
        send(*numbers)


@pytest.mark.parametrize("number", [USR1, USR2])
def test_a_notice_saves_at_the_next_step(number, tmp_path, monkeypatch, capsys):
    due = Trainer._is_due

    def step(self, before, after):
        if after == 7:
            os.kill(os.getpid(), number)
        return due(self, before, after)

    monkeypatch.setattr(Trainer, "_is_due", step)
    assert main(["train", "independent", *TINY, f"output={tmp_path}"]) == 128 + number
    (folder,) = tmp_path.iterdir()
    assert RunFolder(folder).step() == 7
    assert f"resume with: emberlink train resume={folder}" in capsys.readouterr().out


def test_ctrl_c_in_a_function_saves_and_restores_the_handler(tmp_path):
    def press(progress: Progress) -> None:
        if progress.step == 7:
            os.kill(os.getpid(), INT)

    before = signal.getsignal(INT)
    short = {"episodes": 2, "horizon": 15, "num_envs": 2, "learner.batch_size": 8}
    with pytest.raises(KeyboardInterrupt, match="resume"):
        train("independent", output=str(tmp_path / "stopped"), progress=press, **short)
    assert signal.getsignal(INT) is before
    (folder,) = (tmp_path / "stopped").iterdir()
    assert RunFolder(folder).step() == 7
    assert not (folder / "lock").exists()
