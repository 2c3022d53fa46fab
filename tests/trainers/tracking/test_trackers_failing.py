"""Tests that training continues with one warning if a tracker fails in any way."""

import os
import signal
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Callable, Collection
from contextlib import suppress
from pathlib import Path

import pytest
import wandb
from tiny_run import PROGRAM

from emberlink.trainers.cli import main
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.tracking import loggers
from emberlink.trainers.training.trainer import Progress, Trainer

EPISODES = 4
SHORT = [
    *(f"episodes={EPISODES}", "env.horizon=8", "env.num_uavs=2", "fire=paper"),
    *("learner.hidden=[8,8]", "learner.batch_size=8", "evaluation.interval=0"),
]


def train(logger: str, folder: Path, watch: Callable[[Progress], None] = lambda _: None, *more):
    """Trains to the end and returns the warnings about the tracker."""
    config = resolve("independent", [*SHORT, f"logger={logger}", f"output={folder}", *more])
    trainer = Trainer(config)
    trainer.start()
    began = time.monotonic()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert trainer.train(watch)
    assert time.monotonic() - began < 30
    for run in trainer.runs:
        assert [line["episode"] for line in run.metrics()] == list(range(1, EPISODES + 1))
        assert run.checkpoint().name == f"step_{EPISODES * 8:09d}.safetensors"
    return [str(warning.message) for warning in caught if "logger=" in str(warning.message)]


def only(messages: list[str], *words: str) -> None:
    (message,) = messages
    assert message.count("\n") == 0
    for word in (*words, "training continues", "metrics.jsonl"):
        assert word in message


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("WANDB_CACHE_DIR", "WANDB_CONFIG_DIR", "WANDB_DATA_DIR"):
        monkeypatch.setenv(name, str(tmp_path / "wandb-own"))
    for name in ("WANDB_MODE", "WANDB_API_KEY", "WANDB_BASE_URL"):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    monkeypatch.setattr(loggers, "PATIENCE", 1.5)
    forget()
    yield
    for thread in threading.enumerate():
        if thread.name == loggers.WANDB_TEARDOWN:
            thread.join(30)
    forget()


def forget() -> None:
    """Resets wandb, which reads its settings once per process.

    It also removes the environment variable by which wandb finds its service process.
    """
    with suppress(Exception):
        wandb.teardown()
    os.environ.pop("WANDB_SERVICE", None)


class Fragile:
    """A tracker that fails, or blocks forever, in a given method."""

    def __init__(self, stage: str, how: Callable[[], None]):
        self.stage, self.how, self.told = stage, how, []
        self.meet("init")

    def meet(self, stage: str) -> None:
        if stage == self.stage:
            self.how()

    def log(self, line: dict[str, float], episode: int) -> None:
        if episode == 2:
            self.meet("log")
        self.told += [(name, episode) for name in line]

    def finish(self) -> None:
        self.meet("finish")


def fail() -> None:
    raise OSError(28, "No space left on device\nnone at all")


def leave() -> None:
    raise SystemExit(1)


def wait() -> None:
    threading.Event().wait()


@pytest.mark.parametrize("how", [fail, leave, wait])
@pytest.mark.parametrize("stage", ["init", "log", "finish"])
def test_a_tracker_that_fails_or_blocks(stage, how, tmp_path, monkeypatch):
    made = []

    def make(*_):
        made.append(Fragile(stage, how))
        return made[-1]

    monkeypatch.setitem(loggers.TRACKERS, "csv", make)
    expected = {fail: "No space left", leave: "SystemExit", wait: "no answer within 1.5 s"}[how]
    # A stack of two seeds has two trackers but gives one warning.
    only(train("csv", tmp_path, lambda _: None, "seeds=[3,4]"), "logger=csv", expected)
    if stage == "log":
        assert {step for _, step in made[0].told} == {1}  # and no calls after the failure


@pytest.mark.parametrize("logger", ["wandb", "tensorboard"])
def test_a_missing_package_is_an_error_before_training(logger, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(loggers, "find_spec", lambda name: None)
    arguments = ["train", "independent", *SHORT, f"logger={logger}", f"output={tmp_path}/runs"]
    assert main.main(arguments) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert f"logger={logger}: {logger} is not installed: pip install" in error
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("logger", "name"), [("csv", "metrics.csv"), ("tensorboard", "tensorboard")]
)
def test_a_tracker_whose_files_cannot_be_created(logger, name, tmp_path):
    config = resolve("independent", [*SHORT, f"logger={logger}", f"output={tmp_path}"])
    trainer = Trainer(config)
    run = trainer.start()
    if logger == "csv":
        (run.path / name).mkdir()
    else:
        (run.path / name).write_text("in the way")
    with pytest.warns(UserWarning, match=f"logger={logger} has stopped") as caught:
        assert trainer.train()
    assert len([warning for warning in caught if "logger=" in str(warning.message)]) == 1
    assert len(run.metrics()) == EPISODES
    assert logger == "csv" or (run.path / name).read_text() == "in the way"


def test_an_unknown_mode_of_wandb(tmp_path, monkeypatch):
    monkeypatch.setenv("WANDB_MODE", "nonsense")
    only(train("wandb", tmp_path), "logger=wandb", "mode")


def test_wandb_is_switched_off(tmp_path, monkeypatch):
    monkeypatch.setenv("WANDB_MODE", "disabled")
    assert train("wandb", tmp_path) == []
    assert list(tmp_path.rglob("*.wandb")) == []


def test_wandb_cannot_reach_its_server(tmp_path, monkeypatch):
    """No server listens at port 9 of the local machine, and the key is invalid."""
    monkeypatch.setenv("WANDB_MODE", "online")
    monkeypatch.setenv("WANDB_BASE_URL", "http://127.0.0.1:9")
    monkeypatch.setenv("WANDB_API_KEY", "0" * 40)
    monkeypatch.setattr(loggers, "_CONNECTING", 1.0)
    only(train("wandb", tmp_path), "logger=wandb")


def services() -> set[int]:
    """Returns the service processes of wandb that this process has started and that still run."""
    found: set[int] = set()
    for folder in Path("/proc").iterdir():
        try:
            about = (folder / "stat").read_text().rsplit(")", 1)[-1].split()
            command = (folder / "cmdline").read_bytes()
            if int(about[1]) == os.getpid() and about[0] != "Z" and b"wandb-core" in command:
                found.add(int(folder.name))
        except (OSError, IndexError, ValueError):
            continue
    return found


def service(others: Collection[int] = ()) -> int:
    """Returns the service process that wandb has started, or one of the others that it reuses."""
    began = time.monotonic()
    while (waited := time.monotonic() - began) < 20:
        running = services()
        if found := running - set(others) or (running if waited > 5 else None):
            return found.pop()
        time.sleep(0.02)
    raise AssertionError("wandb has started no process")


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs Linux's /proc")
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP])
def test_the_process_of_wandb_is_killed_or_stopped(how, tmp_path):
    struck: list[int] = []
    before = services()  # that of an earlier test may still be ending

    def strike(progress: Progress) -> None:
        if progress.step == 10:
            time.sleep(1)  # it may still be starting
            struck.append(service(before))
            os.kill(struck[0], how)
            time.sleep(0.3)

    try:
        only(train("wandb", tmp_path, strike), "logger=wandb")
    finally:
        for process in struck:
            with suppress(ProcessLookupError):  # wandb may have waited for the killed one
                os.kill(process, signal.SIGKILL)


@pytest.mark.heavy
def test_a_program_exits_normally_if_wandb_was_killed(tmp_path):
    """Errors of wandb at the end of the program are not printed."""
    program = (
        "import os, signal, time\n"
        "from test_trackers_failing import service\n"
        "from emberlink.trainers.training.trainer import Trainer\n"
        "finish = Trainer._finish_episode\n"
        "def strike(self, *rest):\n"
        "    if self.setup.episode == 2:\n"
        "        os.kill(service(), signal.SIGKILL)\n"
        "        time.sleep(0.3)\n"
        "    return finish(self, *rest)\n"
        "Trainer._finish_episode = strike\n" + PROGRAM
    )
    arguments = ["train", "independent", *SHORT, "evaluation.episodes=1", "logger=wandb"]
    done = subprocess.run(
        [sys.executable, "-c", program, *arguments, f"output={tmp_path / 'runs'}"],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])},
        check=False,
        timeout=100,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("logger=wandb has stopped") == 1, done.stderr
    assert "Traceback" not in done.stderr
    (folder,) = (tmp_path / "runs").iterdir()
    assert (folder / "metrics.jsonl").read_text().count("\n") == EPISODES
    assert (folder / "eval.json").exists()


def test_without_a_tracker(tmp_path):
    assert train("none", tmp_path) == []
    assert main.main(["train", "independent", *SHORT, "logger=mlflow", f"output={tmp_path}/x"]) == 2
