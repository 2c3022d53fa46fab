"""Ends trainings by a signal or a full disk."""

import errno
import os
import random
import resource
import shutil
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path

from children import (
    EPISODES,
    HORIZON,
    RECIPES,
    SMALL,
    Child,
    outcome,
    reference,
    temporary,
    training,
)

from emberlink.trainers.cli import main
from emberlink.trainers.runs.run_folder import NEWEST, RunFolder
from emberlink.trainers.training.resume import resume


def command(arguments: list[str], before: Callable[[], None] = lambda: None):
    """Starts `emberlink` with arguments in a forked process."""

    def work(say: Callable[[str], None]) -> int:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        before()
        say("here")
        return main.main(arguments)

    return work


def signal_trial(number: int, folder: Path, draw: random.Random) -> list[str]:
    """Sends a signal at a random time of a training; returns the failures."""
    (method, own), output = draw.choice(RECIPES[:3]), folder / "runs"
    arguments = ["train", method, *SMALL, *own, "episodes=100000", f"output={output}"]
    child, failures = Child(command(arguments), folder), []
    saved, step = output.glob, draw.randint(1, 30)
    child.wait_for(lambda: any(RunFolder(p.parent).step() >= step for p in saved(f"*/{NEWEST}")))
    child.send(number)
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
    done = -(-run.step() // HORIZON)

    def go_on(say: Callable[[str], None]) -> int:
        return not resume(path, method, [f"episodes={done}"]).train()

    again = Child(go_on, folder)
    if again.end() != 0:
        failures.append(again.text())
    shutil.rmtree(folder)
    return failures


def full_disk_trial(folder: Path, draw: random.Random, *, mount: bool = False) -> list[str]:
    """Trains on a disk that becomes full; returns the failures.

    Args:
        folder: an empty folder.
        draw: random numbers for the size of the disk.
        mount: whether to mount a small file system (as root) or to limit the size of every file.
    """
    method, own = RECIPES[0]
    undisturbed = folder.parent / "reference_0"
    expected = reference(0, undisturbed)
    (size,) = (path.stat().st_size for path in undisturbed.rglob(NEWEST))
    output, failures = folder / "disk" / "runs", []
    output.mkdir(parents=True)
    if mount:
        room = draw.randint(size, 2 * size + 60_000)
        subprocess.run(
            ["mount", "-t", "tmpfs", "-o", f"size={room}", "tmpfs", str(output)], check=True
        )

    def limited() -> None:
        if not mount:
            room = draw.randint(size // 2, size - 300)
            resource.setrlimit(resource.RLIMIT_FSIZE, (room, room))

    try:
        arguments = ["train", method, *SMALL, *own, f"episodes={EPISODES}", f"output={output}"]
        child = Child(command(arguments, limited), folder)
        status, text = child.end(), child.text()
        (path,) = output.iterdir()
        run = RunFolder(path)
        (error,) = [line for line in text.splitlines() if line.startswith("emberlink train:")]
        why = os.strerror(errno.ENOSPC if mount else errno.EFBIG)
        if status != 2 or why not in error or "Traceback" in text:
            failures.append(f"{status}: {text}")
        good = str(run.newest) if run.newest.exists() else "there is no checkpoint"
        if good not in error or f"emberlink train resume={path}" not in error:
            failures.append(f"does not name the last good checkpoint: {error}")
        if temporary(path):
            failures.append(f"left: {temporary(path)}")
        if not all(file.read_bytes().endswith(b"\n") for file in path.glob("*.jsonl")):
            failures.append("half a line")
        if mount:
            subprocess.run(["mount", "-o", "remount,size=100m", str(output)], check=True)
        again = Child(training(0, output), folder)
        if again.end() != 0 or outcome(output) != expected:
            failures.append(f"cannot be resumed: {again.text()}")
    finally:
        if mount:
            subprocess.run(["umount", str(output)], check=True)
    shutil.rmtree(folder)
    return failures
