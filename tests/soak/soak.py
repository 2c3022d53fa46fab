"""Stops trainings in all known ways, many times, and prints a table.

python tests/soak/soak.py            # about half an hour
python tests/soak/soak.py --small    # a tenth of it
"""

import argparse
import errno
import json
import os
import random
import resource
import shutil
import signal
import tempfile
import time
import traceback
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")

from emberlink.envs.utils import atomic_io
from emberlink.trainers.cli import main as command_line
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.runs import checkpoint
from emberlink.trainers.runs.run_folder import BEST, METRICS, NEWEST, RunFolder
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
Say = Callable[[str], None]


class Child:
    """A process that is forked after the imports and writes its progress to a log.

    Args:
        work: called with a function that writes a line to the log; returns the exit status.
        folder: folder for the files `log` and `out`, the printed output.
    """

    def __init__(self, work: Callable[[Say], int], folder: Path):
        folder.mkdir(parents=True, exist_ok=True)
        self._files = folder / "log", folder / "out"
        for file in self._files:
            file.write_text("")
        self.pid = os.fork()
        if self.pid == 0:
            status = 99
            try:
                log, out = (os.open(file, os.O_WRONLY | os.O_APPEND) for file in self._files)
                os.dup2(out, 1)
                os.dup2(out, 2)
                status = work(lambda line: os.write(log, f"{line}\n".encode()) and None)
            except BaseException:
                traceback.print_exc()
            finally:
                os._exit(status)

    def lines(self) -> list[str]:
        return self._files[0].read_text().splitlines()

    def text(self) -> str:
        return self._files[1].read_text()

    def kill_when(self, condition: Callable[[], object], number: int, after: float = 0) -> None:
        """Sends a signal some seconds after a condition, or nothing if the process ends before."""
        end = time.monotonic() + 120
        while not condition():
            assert time.monotonic() < end, self.text()
            if os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT):
                return
            time.sleep(0.002)
        time.sleep(after)
        os.kill(self.pid, number)

    def end(self) -> int:
        """Returns the exit status, or the negative number of the signal that ended the process."""
        return os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])


def temporary(folder: Path) -> list[str]:
    """Returns the temporary files of incomplete saves."""
    return sorted(path.name for path in [*folder.rglob("*.part"), *folder.rglob(".tmp*")])


def watch_saves(say: Say, die_at: tuple[str, int] | None) -> None:
    """Logs every save, and kills this process at the n-th call of a function of a save.

    It patches modules, so that it must run in a forked process.
    """
    calls = 0

    def dying(place: object, name: str) -> None:
        function = getattr(place, name)

        def call(*arguments, **named):
            nonlocal calls
            calls += die_at is not None and die_at[0] == name
            if die_at == (name, calls):
                os.kill(os.getpid(), signal.SIGKILL)
            return function(*arguments, **named)

        setattr(place, name, call)

    for place, name in zip((checkpoint, os, Path, atomic_io, Path), PARTS, strict=True):
        dying(place, name)
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

    def work(say: Say) -> int:
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


def command(recipe: int, output: Path, episodes: int, before: Callable[[], object]):
    """Starts `emberlink train` in a forked process."""
    method, own = RECIPES[recipe]
    arguments = ["train", method, *SMALL, *own, f"episodes={episodes}", f"output={output}"]

    def work(_: Say) -> int:
        before()
        return command_line.main(arguments)

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
            child.kill_when(child.lines, signal.SIGKILL, draw.uniform(0, 0.3))
        elif kind == "save":
            last = draw.randint(1, 4)
            child.kill_when(
                lambda c=child, n=last: "".join(c.lines()).count("saving") >= n,
                *(signal.SIGKILL, draw.uniform(0, 0.015)),
            )
        status = child.end()
        for line in child.lines():
            word, step, *left = line.split()
            if word == "at":
                # The newest complete save, or the save whose log line was lost by the kill.
                if int(step) not in (saved, begun):
                    failures.append(f"resumed at {step}; saved {saved}, begun {begun}")
                if left:
                    failures.append(f"left after the resume: {left}")
            if word == "saving":
                begun = int(step)
            else:
                saved = int(step)
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


def kill_trials(folder: Path, kills: int, draw: random.Random) -> tuple[int, list[str]]:
    """Kills runs of all recipes `kills` times in total.

    Returns:
        The number of kills and the failures.
    """
    done, failures, number = 0, [], 0
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


def signal_trial(number: int, folder: Path, draw: random.Random) -> list[str]:
    """Sends a signal at a random time of a training; returns the failures."""
    output, step, failures = folder / "runs", draw.randint(1, 30), []
    heeded = command(
        *(draw.randrange(3), output, 100_000),
        lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    child, saved = Child(heeded, folder), output.glob
    child.kill_when(
        lambda: any(RunFolder(p.parent).step() >= step for p in saved(f"*/{NEWEST}")), number
    )
    status, text = child.end(), child.text()
    (path,) = output.iterdir()
    if status != 128 + number:
        failures.append(f"exit status {status}")
    if f"resume with: emberlink train resume={path}" not in text or "Traceback" in text:
        failures.append(text)
    run = RunFolder(path)
    if len(run.metrics()) != run.step() // HORIZON:
        failures.append("metrics.jsonl and the checkpoint are of different steps")
    if temporary(path) or (path / "lock").exists():
        failures.append(f"left: {sorted(p.name for p in path.rglob('*'))}")
    # With the smallest possible number of episodes, so that it ends soon.
    more = [f"episodes={-(-run.step() // HORIZON)}"]
    again = Child(lambda _: not resume(path, overrides=more).train(), folder)
    return failures if again.end() == 0 else [*failures, again.text()]


def full_disk_trial(folder: Path, draw: random.Random) -> list[str]:
    """Trains where files cannot become larger than a checkpoint; returns the failures."""
    undisturbed, output, failures = folder.parent / "reference_0", folder / "runs", []
    expected = reference(0, undisturbed)
    (size,) = (path.stat().st_size for path in undisturbed.rglob(NEWEST))
    room = draw.randint(size // 2, size - 300)
    limited = command(
        *(0, output, EPISODES), lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (room, room))
    )
    child = Child(limited, folder)
    status, text = child.end(), child.text()
    (path,) = output.iterdir()
    run = RunFolder(path)
    (error,) = [line for line in text.splitlines() if line.startswith("emberlink train:")]
    if status != 2 or os.strerror(errno.EFBIG) not in error or "Traceback" in text:
        failures.append(f"{status}: {text}")
    good = str(run.newest) if run.newest.exists() else "there is no checkpoint"
    if good not in error or f"emberlink train resume={path}" not in error:
        failures.append(f"does not name the last good checkpoint: {error}")
    if temporary(path):
        failures.append(f"left: {temporary(path)}")
    if not all(file.read_bytes().endswith(b"\n") for file in path.glob("*.jsonl")):
        failures.append("half a line")
    again = Child(training(0, output), folder)
    if again.end() != 0 or outcome(output) != expected:
        failures.append(f"cannot be resumed: {again.text()}")
    return failures


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--small", action="store_true", help="a tenth of the trials")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--counts", type=json.loads, help="of each kind, as JSON")
    options = parser.parse_args()
    counts = {"kill -9": 200, "SIGTERM": 50, "SIGINT": 50, "file size limit": 50}
    if options.small:
        counts = {name: count // 10 for name, count in counts.items()}
    draw, failed = random.Random(options.seed), False
    trials = {
        "SIGTERM": lambda here: signal_trial(signal.SIGTERM, here, draw),
        "SIGINT": lambda here: signal_trial(signal.SIGINT, here, draw),
        "file size limit": lambda here: full_disk_trial(here, draw),
    }
    print("| trial | how many | failures | seconds |\n|---|---|---|---|", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        for name, count in (options.counts or counts).items():
            began, failures = time.monotonic(), []
            if name == "kill -9":
                count, failures = kill_trials(Path(folder), count, draw)
            else:
                for _ in range(count):
                    failures += trials[name](Path(folder) / "trial")
                    shutil.rmtree(Path(folder) / "trial")
            seconds = time.monotonic() - began
            print(f"| {name} | {count} | {len(failures)} | {seconds:.0f} |", flush=True)
            for failure in failures[:5]:
                print("   ", failure[:1000], flush=True)
            failed |= bool(failures)
    return int(failed)


if __name__ == "__main__":
    raise SystemExit(main())
