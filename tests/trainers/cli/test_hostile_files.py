"""Tests that malicious files are refused wherever a file is read, and that no code runs."""

import io
import json
import os
import resource
import shutil
import struct
import time
from pathlib import Path

import pytest
import torch
import yaml
from refusal import refused

from emberlink.trainers.runs.run_folder import RunFolder


class Bomb:
    """Creates a file when it is unpickled."""

    def __init__(self, mark: Path):
        self.mark = mark

    def __reduce__(self):
        return os.mkdir, (str(self.mark),)


@pytest.fixture
def mark(tmp_path) -> Path:
    return tmp_path / "mark"


def harmless(arguments: list, capsys, mark: Path) -> str:
    """Returns the one-line error of a command and checks its time, its memory and the mark."""
    before, began = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.monotonic()
    err = refused(arguments, capsys)
    assert err[:-1].isprintable(), err
    assert len(err) < 700
    assert time.monotonic() - began < 15
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 500_000  # kB
    assert not mark.exists()
    return err


def torch_saved(mark: Path) -> bytes:
    into = io.BytesIO()
    torch.save({"actor": Bomb(mark)}, into)
    return into.getvalue()


def safetensors(header: object, body: bytes = b"") -> bytes:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text + body


def promising(shape: list[int], end: int) -> bytes:
    about = {"dtype": "F32", "shape": shape, "data_offsets": [0, end]}
    return safetensors({"actor_network_params.module.0": about}, b"\0" * 64)


CHECKPOINTS = {
    "torch.save": torch_saved,
    "header longer than the file": lambda _: struct.pack("<Q", 2**63) + b"{}",
    "tensor larger than the file": lambda _: promising([2**40], 2**42),
    "metadata that is code": lambda _: safetensors(
        {"__metadata__": {"emberlink": "__import__('os').mkdir('mark')"}}
    ),
}


@pytest.mark.parametrize("kind", CHECKPOINTS)
def test_a_checkpoint(kind, run, mark, capsys):
    RunFolder(run).newest.write_bytes(CHECKPOINTS[kind](mark))
    for command in (["eval", run], ["train", f"resume={run}"]):
        assert "checkpoint.safetensors" in harmless(command, capsys, mark)


CONFIGS = {
    "apply": "seed: !!python/object/apply:os.mkdir [{mark}]\n",
    "interpolation": "seed: ${{oc.env:HOME}}\n",
}


@pytest.mark.parametrize("kind", CONFIGS)
def test_a_configuration(kind, run, mark, capsys):
    """Only a run without a checkpoint is built from its config.yaml."""
    RunFolder(run).newest.unlink()
    file = run / "config.yaml"
    hostile = CONFIGS[kind].format(mark=mark)
    whole = yaml.safe_load(file.read_text())  # otherwise valid
    whole.pop(hostile.partition(":")[0], None)
    file.write_text(yaml.safe_dump(whole) + hostile)
    assert "config.yaml" in harmless(["train", f"resume={run}"], capsys, mark)


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("checkpoint.safetensors", "link"),
        ("lock", "pipe"),
        ("figures", "link to nothing"),
        ("notes/mine.txt", "device"),
    ],
)
def test_a_run_folder_with_a_link_or_a_pipe_is_refused(name, kind, run, mark, capsys, tmp_path):
    """Every command opens a run folder through one door; nothing outside changes."""
    path, mine = run / name, tmp_path / "mine"
    mine.write_text("mine")
    path.parent.mkdir(exist_ok=True)
    path.unlink() if path.is_file() else shutil.rmtree(path, ignore_errors=True)
    if kind == "pipe":
        os.mkfifo(path)
    else:
        targets = {"device": Path("/dev/zero"), "link": mine, "link to nothing": tmp_path / "new"}
        path.symlink_to(targets[kind])
    for command in (["train", f"resume={run}", "episodes=3"], ["eval", run], ["render", run]):
        assert f"{path}: a link, a pipe or a device" in harmless(command, capsys, mark)
    assert str(path) in harmless(["compare", run, "--output", tmp_path / "out"], capsys, mark)
    assert mine.read_text() == "mine"
    assert {p.name for p in tmp_path.iterdir()} <= {"mine", "run"}
