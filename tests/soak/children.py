"""Runs trainings in processes that are forked after the imports, and kills them."""

import math
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
from emberlink.trainers.runs import checkpoint_file
from emberlink.trainers.training.resume import resume
from emberlink.trainers.training.trainer import Trainer

HORIZON, EPISODES, EVERY = 20, 4, 3
BASE = [
    *(f"env.horizon={HORIZON}", "env.num_uavs=2", "num_envs=2", f"checkpoint_steps={EVERY}"),
    *("learner.hidden=[8,8]", "fire=paper", "keep_checkpoints=3"),
    *("evaluation.interval=0", "evaluation.episodes=1"),
]
REPLAY = ["learner.batch_size=16", "learner.buffer_size=60"]
SMALL = [*BASE, *REPLAY]
SEQUENCES = [*REPLAY, "policy.memory=gru", "learner.sequence=4", "learner.burn_in=2"]
LEARNERS = {
    "ddpg": ["learner=ddpg", *REPLAY],
    "ddpg-gru": ["learner=ddpg", *SEQUENCES],
    "td3-team": ["learner=td3", *SEQUENCES, "learner.critic=team"],
    "ippo-own": ["learner=ippo", "policy.memory=gru", "learner.share_parameters=false"],
    "mappo": ["learner=mappo", "policy.memory=stack", "policy.hold=2"],
    "mappo-map": ["learner=mappo", "policy.memory=gru", "learner.critic_map=true"],
}
IMITATION = ["learner=imitation", "learner.samples=8", "learner.buffer_size=60"]
SETTINGS = {**LEARNERS, "imitation": IMITATION}
METHODS = ("independent", "shared_memory", "positional", "consensus")


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
        """Waits for a line in the log; returns whether it was written before the process ended."""
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
    files = [*folder.rglob("*.part"), *folder.rglob(".tmp*")]
    return sorted(path.name for path in files)


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

    for name in ("save_file", "_digest"):
        setattr(checkpoint_file, name, dying(name, getattr(checkpoint_file, name)))
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


def training(method: str, learner: str, output: Path, die_at: tuple[str, int] | None = None):
    """Starts a run, or resumes an existing one, and trains to the end."""
    settings = [*BASE, *SETTINGS[learner], f"episodes={EPISODES}"]

    def work(say: Callable[[str], None]) -> int:
        watch_saves(say, die_at)
        runs = sorted(output.glob("*/config.yaml"))
        if runs:
            trainer = resume(runs[0].parent)
        else:
            trainer = Trainer(resolve(method, [*settings, f"output={output}"]))
            trainer.start()
        say(f"at {trainer.setup.step} {','.join(temporary(output))}")
        trainer.train()
        return 0

    return work


PARTS = ("save_file", "_digest", "fsync", "replace", "sync", "unlink")


def kill_until_finished(
    method: str, learner: str, folder: Path, draw: random.Random, kills: int
) -> tuple[int, list[str]]:
    """Kills and resumes a training at random times until it has finished.

    Args:
        method: name of the method.
        learner: name of the learner, one of `SETTINGS`.
        folder: an empty folder.
        draw: random numbers for the times.
        kills: maximum number of kills.

    Returns:
        The number of kills and the failures.
    """
    output, failures, done, saved = folder / "runs", [], 0, 0
    begun = saved
    while True:
        kind = draw.choice(("time", "save", "part")) if done < kills else "none"
        part = draw.choice(PARTS), draw.randint(1, 12)
        child = Child(training(method, learner, output, part if kind == "part" else None), folder)
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
        lines = child.lines()
        for line in lines:
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
        for path in output.rglob("checkpoints/*.safetensors"):
            if not path.name.startswith(".tmp"):
                try:
                    checkpoint_file.read(path)
                except ValueError as error:
                    failures.append(str(error))
        if status == -signal.SIGKILL:
            done += 1
        elif status == 0:
            return done, failures
        else:
            return done, [*failures, f"status {status}: {child.text()}"]


def outcome(output: Path) -> dict[str, bytes]:
    """Returns the networks and the complete files of a finished run."""
    (folder,) = output.iterdir()
    networks = sorted((folder / "checkpoints").glob("step_*.safetensors"))[-1]
    files = [networks, folder / "checkpoints" / "best.safetensors", folder / "metrics.jsonl"]
    return {path.name: path.read_bytes() for path in files}


def reference(method: str, learner: str, folder: Path) -> dict[str, bytes]:
    """Returns the outcome of an uninterrupted run."""
    child = Child(training(method, learner, folder / "runs"), folder)
    assert child.end() == 0, child.text()
    return outcome(folder / "runs")


def kill_trials(folder: Path, kills: int, seed: int) -> tuple[int, list[str]]:
    """Kills runs of all methods with all learners `kills` times in total.

    The first six runs are of all methods and all learners, the seventh is an imitation; the first
    25 are of all pairs and an imitation.

    Returns:
        The number of kills and the failures.
    """
    draw, done, failures, number = random.Random(seed), 0, [], 0
    references: dict[tuple[str, str], dict[str, bytes]] = {}
    most = min(8, max(1, kills // len(LEARNERS)))
    names, cycle = [*LEARNERS], math.lcm(len(METHODS), len(LEARNERS))
    recipes = [
        (METHODS[n % len(METHODS)], names[(n + n // cycle) % len(names)])
        for n in range(len(METHODS) * len(LEARNERS))
    ]
    recipes.insert(len(LEARNERS), ("maps", "imitation"))
    while done < kills:
        recipe = recipes[number % len(recipes)]
        if recipe not in references:
            references[recipe] = reference(*recipe, folder / f"reference_{'_'.join(recipe)}")
        here = folder / f"kill_{number}"
        killed, new = kill_until_finished(*recipe, here, draw, min(kills - done, most))
        if not new and outcome(here / "runs") != references[recipe]:
            new = [f"{recipe}: the outcome differs from that of the uninterrupted run"]
        failures += new
        done, number = done + killed, number + 1
        shutil.rmtree(here)
    return done, failures
