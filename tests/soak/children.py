"""Runs trainings in processes that are forked after the imports, and kills them."""

import os
import random
import shutil
import signal
import time
import traceback
from collections.abc import Callable
from pathlib import Path

from emberlink.envs.utils import atomic_io
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.runs import checkpoint
from emberlink.trainers.runs.run_folder import BEST, METRICS, NEWEST
from emberlink.trainers.training.resume import resume
from emberlink.trainers.training.trainer import Trainer

HORIZON, EPISODES, EVERY = 20, 4, 3
SMALL = [
    *(f"env.horizon={HORIZON}", "env.num_uavs=2", "num_envs=2", f"checkpoint_steps={EVERY}"),
    *("learner.hidden=[8,8]", "fire=paper", "evaluation.interval=0", "evaluation.episodes=1"),
]
REPLAY = ["learner.batch_size=16", "learner.buffer_size=60"]
GRU = ["policy.memory=gru", "policy.units=6"]
RECIPES = [
    ("independent", ["learner=ddpg", *REPLAY]),
    ("consensus", ["learner=ippo", *GRU, "learner.share_parameters=false"]),
    ("positional", ["learner=td3", *REPLAY, "learner.critic=team"]),
    ("shared_memory", ["learner=mappo", *GRU, "policy.hold=2"]),
    ("maps", ["learner=imitation", "learner.samples=8", "learner.buffer_size=60"]),
    ("independent", ["learner=mappo", *GRU, "learner.critic_map=true"]),
    ("consensus", ["learner=ddpg", *REPLAY, "policy.hold=2", "env.failures=1"]),
]
PARTS = ("save_file", "fsync", "replace", "sync", "unlink")


class Child:
    """A forked process that writes its progress to a log.

    Args:
        work: called with a function that writes a line to the log; returns the exit status.
        folder: folder for the files `log` and `out`, the printed output.
    """

    def __init__(self, work: Callable[[Callable[[str], None]], int], folder: Path):
        folder.mkdir(parents=True, exist_ok=True)
        self.log, self.out = folder / "log", folder / "out"
        for file in (self.log, self.out):
            file.unlink(missing_ok=True)
        self.pid = os.fork()
        if self.pid == 0:
            status = 99
            try:
                out = os.open(self.out, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
                os.dup2(out, 1)
                os.dup2(out, 2)
                log = os.open(self.log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
                status = work(lambda line: os.write(log, f"{line}\n".encode()) and None)
            except BaseException:
                traceback.print_exc()
            finally:
                os._exit(status)

    def lines(self) -> list[str]:
        return self.log.read_text().splitlines() if self.log.exists() else []

    def wait_for(self, condition: Callable[[], bool], seconds: float = 120) -> bool:
        """Waits for a condition; returns whether it came before the process ended."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if condition():
                return True
            if os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT):
                return condition()
            time.sleep(0.002)
        raise TimeoutError(f"{self.lines()} {self.text()}")

    def send(self, number: int) -> None:
        os.kill(self.pid, number)

    def end(self) -> int:
        """Returns the exit status, or the negative number of the signal that ended the process."""
        return os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])

    def text(self) -> str:
        return self.out.read_text() if self.out.exists() else ""


def temporary(folder: Path) -> list[str]:
    """Returns the temporary files of incomplete saves."""
    return sorted(path.name for path in [*folder.rglob("*.part"), *folder.rglob(".tmp*")])


def watch_saves(say: Callable[[str], None], die_at: tuple[str, int] | None) -> None:
    """Logs every save, and kills this process at the n-th call of a function of a save.

    It patches modules, so that it must run in a forked process.
    """
    calls = 0

    def dying(name: str, function: Callable) -> Callable:
        def call(*arguments, **named):
            nonlocal calls
            if die_at is not None and die_at[0] == name:
                calls += 1
                if calls == die_at[1]:
                    os.kill(os.getpid(), signal.SIGKILL)
            return function(*arguments, **named)

        return call

    checkpoint.save_file = dying("save_file", checkpoint.save_file)
    atomic_io.sync = dying("sync", atomic_io.sync)
    os.fsync = dying("fsync", os.fsync)
    Path.replace = dying("replace", Path.replace)
    Path.unlink = dying("unlink", Path.unlink)
    save = Trainer.save

    def saying(trainer: Trainer) -> None:
        say(f"saving {trainer.setup.step}")
        save(trainer)
        say(f"saved {trainer.setup.step}")

    Trainer.save = saying


def training(recipe: int, output: Path, die_at: tuple[str, int] | None = None):
    """Starts a run, or resumes an existing one, and trains to the end."""
    method, own = RECIPES[recipe % len(RECIPES)]
    settings = [*SMALL, *own, f"episodes={EPISODES}", f"output={output}"]

    def work(say: Callable[[str], None]) -> int:
        runs = sorted(output.glob("*/config.yaml"))
        if runs:
            watch_saves(say, die_at)
            trainer = resume(runs[0].parent)
        else:  # a folder without config.yaml is no run: the kills begin with the training
            trainer = Trainer(resolve(method, settings))
            trainer.start()
            watch_saves(say, die_at)
        say(f"at {trainer.setup.step} {','.join(temporary(output))}")
        trainer.train()
        return 0

    return work


def kill_until_finished(
    recipe: int, folder: Path, draw: random.Random, kills: int
) -> tuple[int, list[str]]:
    """Kills and resumes a training at random times until it has finished.

    Returns:
        The number of kills and the failures.
    """
    output, failures, done, saved, begun = folder / "runs", [], 0, 0, 0
    while True:
        kind = draw.choice(("time", "save", "part")) if done < kills else "none"
        part = draw.choice(PARTS), draw.randint(1, 12)
        child = Child(training(recipe, output, part if kind == "part" else None), folder)
        if kind == "time":
            child.wait_for(lambda c=child: bool(c.lines()))
            time.sleep(draw.uniform(0, 0.3))
        elif kind == "save":
            last = draw.randint(1, 4)
            child.wait_for(
                lambda c=child, n=last: sum(x.startswith("saving") for x in c.lines()) >= n
            )
            time.sleep(draw.uniform(0, 0.015))
        if kind in ("time", "save"):
            child.send(signal.SIGKILL)
        status = child.end()
        for line in child.lines():
            word, _, rest = line.partition(" ")
            if word == "at":
                step, _, left = rest.partition(" ")
                # The newest complete save, or the save whose log line was lost by the kill.
                if int(step) not in (saved, begun):
                    failures.append(f"resumed at {step}; saved {saved}, begun {begun}")
                if left:
                    failures.append(f"left after the resume: {left}")
                saved = int(step)
            elif word == "saving":
                begun = int(rest)
            else:
                saved = int(rest)
        if status == -signal.SIGKILL:
            done += 1
        elif status == 0:
            return done, failures
        else:
            return done, [*failures, f"status {status}: {child.text()}"]


def outcome(output: Path) -> dict[str, bytes]:
    """Returns the metrics and the checkpoints of a finished run."""
    (folder,) = output.iterdir()
    return {name: (folder / name).read_bytes() for name in (NEWEST, BEST, METRICS)}


def reference(recipe: int, folder: Path) -> dict[str, bytes]:
    """Returns the outcome of an uninterrupted run, which is trained once."""
    if not folder.exists():
        child = Child(training(recipe, folder / "runs"), folder)
        assert child.end() == 0, child.text()
    return outcome(folder / "runs")


def kill_trials(folder: Path, kills: int, seed: int) -> tuple[int, list[str]]:
    """Kills runs of all recipes `kills` times in total.

    Returns:
        The number of kills and the failures.
    """
    draw, done, failures, number = random.Random(seed), 0, [], 0
    most = min(8, max(1, kills // len(RECIPES)))
    while done < kills:
        expected = reference(number, folder / f"reference_{number % len(RECIPES)}")
        here = folder / f"kill_{number}"
        killed, new = kill_until_finished(number, here, draw, min(kills - done, most))
        if not new and outcome(here / "runs") != expected:
            new = [f"{RECIPES[number % len(RECIPES)]}: differs from the uninterrupted run"]
        failures += new
        done, number = done + killed, number + 1
        shutil.rmtree(here)
    return done, failures
