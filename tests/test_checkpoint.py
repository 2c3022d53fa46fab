"""Checkpoint files: written whole or not at all, and nothing damaged is read."""

import errno
import json
import os
import shutil
from pathlib import Path

import pytest
import torch
from damage import damage_trials, without_a_seal
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import load_file, save_file
from soak import readable
from test_recipes import METHODS
from test_resume import until

from emberlink.trainers import checkpoint, cli, report
from emberlink.trainers.resume import resume
from emberlink.trainers.run_folder import RunFolder, load_weights

RELEASED = Path(__file__).parent / "released"
"""run folders as earlier versions left them"""


@settings(max_examples=30, deadline=None)
@given(
    st.dictionaries(st.text("abc./_", min_size=1), st.integers(0, 4), max_size=4),
    st.dictionaries(st.text(min_size=1), st.floats(allow_nan=False) | st.text()),
)
def test_what_is_written_is_read(tmp_path_factory, sizes, header):
    path = tmp_path_factory.mktemp("checkpoint") / "one.safetensors"
    content = {name: torch.randn(size) for name, size in sizes.items()}
    own = {key: value for key, value in header.items() if key not in ("sha256", "format")}
    checkpoint.write(path, content, own)
    found, tensors = checkpoint.read(path)
    assert found is not None
    assert {k: v for k, v in found.items() if k not in ("sha256", "format")} == own
    assert tensors.keys() == content.keys()
    assert all(tensors[name].equal(value) for name, value in content.items())
    assert [one.name for one in path.parent.iterdir()] == [path.name]


def test_every_byte_is_sealed(tmp_path):
    path = tmp_path / "one.safetensors"
    checkpoint.write(path, {"a": torch.arange(5.0)}, {"kind": "networks", "step": 3})
    sound = path.read_bytes()
    for place in range(len(sound)):
        flipped = bytearray(sound)
        flipped[place] ^= 1 << place % 8
        path.write_bytes(flipped)
        with pytest.raises(ValueError, match=r"one\.safetensors"):
            checkpoint.read(path)
    for length in range(len(sound)):
        path.write_bytes(sound[:length])
        with pytest.raises(ValueError, match=r"one\.safetensors"):
            checkpoint.read(path)


@pytest.mark.parametrize("method", METHODS)
def test_nothing_damaged_or_of_something_else_is_accepted(method, tmp_path):
    files = readable(tmp_path, method)
    done, wrong = damage_trials(files, 26, METHODS.index(method))
    assert done == 26
    assert wrong == []


def test_a_state_without_a_seal_is_refused_and_the_one_before_it_is_named(tmp_path, capsys):
    (path, _), _ = readable(tmp_path, "consensus")
    run = RunFolder(path.parent.parent)
    assert len(run.states()) == 2
    without_a_seal(path, None)  # pyright: ignore[reportArgumentType]
    before = {one: one.read_bytes() for one in run.path.rglob("*") if one.is_file()}
    assert cli.main(["train", f"resume={run.path}"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert f"the one before it: emberlink train resume={run.states()[0]}" in error
    assert before == {one: one.read_bytes() for one in run.path.rglob("*") if one.is_file()}
    trainer = resume(run.states()[0])
    assert trainer.step == 30
    assert not path.exists()
    until(trainer, None)
    with pytest.raises(ValueError, match="nothing can be resumed from it"):
        resume(run.checkpoint())


def test_networks_from_before_there_was_a_seal(run, capsys):
    path = RunFolder(run).checkpoint()
    save_file(load_file(path), path)
    assert checkpoint.read_header(path) is None
    assert cli.main(["eval", str(run)]) == 0
    for state in RunFolder(run).states():
        state.unlink()
    capsys.readouterr()
    assert cli.main(["train", f"resume={run}"]) == 2
    assert "holds networks alone" in capsys.readouterr().err


@pytest.mark.parametrize("folder", sorted(RELEASED.iterdir()), ids=lambda folder: folder.name)
def test_files_of_earlier_versions(folder, tmp_path):
    """They evaluate, and those that hold a state are resumed to the numbers of then.

    To a few digits: another machine adds up in another order.
    """
    here = RunFolder(shutil.copytree(folder, tmp_path / "run"))
    for path in here.networks():
        report.load_actor(here.config(), path)
    expected = json.loads((folder / "expected.json").read_text())
    assert load_weights(here.checkpoint(), {}) == {}
    if not here.states():
        with pytest.raises(ValueError, match="holds networks alone"):
            resume(here.path)
        return
    trainer = resume(here.path)
    assert trainer.step == expected["step"]
    until(trainer, None)
    assert len(here.lines()) == len(expected["lines"])
    for line, then in zip(here.lines(), expected["lines"], strict=True):
        assert line == pytest.approx(then, rel=1e-3, abs=1e-3)


@pytest.mark.parametrize("part", ["save_file", "fsync", "replace"])
def test_a_save_that_fails_leaves_what_was_there(part, tmp_path, monkeypatch):
    path = tmp_path / "one.safetensors"
    checkpoint.write(path, {"a": torch.ones(3)}, {})
    before = path.read_bytes()

    def full(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr({"save_file": checkpoint, "fsync": os, "replace": Path}[part], part, full)
    with pytest.raises(ValueError, match=r"one\.safetensors: cannot be written: No space left"):
        checkpoint.write(path, {"a": torch.zeros(3)}, {})
    monkeypatch.undo()
    assert path.read_bytes() == before
    assert [one.name for one in tmp_path.iterdir()] == [path.name]


def test_what_is_written_is_flushed_before_it_gets_its_name(tmp_path, monkeypatch):
    """The file, then the rename, then the folder's names."""
    done, fsync, replace = [], os.fsync, Path.replace

    def flushing(handle: int) -> None:
        done.append(os.readlink(f"/proc/self/fd/{handle}"))
        fsync(handle)

    def renaming(path: Path, target: Path) -> Path:
        done.append("rename")
        return replace(path, target)

    monkeypatch.setattr(os, "fsync", flushing)
    monkeypatch.setattr(Path, "replace", renaming)
    path = tmp_path.resolve() / "one.safetensors"
    checkpoint.write(path, {"a": torch.ones(3)}, {})
    assert done == [f"{path}.part", "rename", str(path.parent)]


def test_a_line_is_written_whole_or_not_at_all(tmp_path, monkeypatch):
    run, write = RunFolder(tmp_path), os.write
    run.append("metrics.jsonl", {"episode": 1})
    calls = iter([4, None])

    def filling(handle: int, content: bytes) -> int:
        room = next(calls)
        if room is None:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write(handle, content[:room])

    monkeypatch.setattr(os, "write", filling)
    with pytest.raises(ValueError, match=r"metrics\.jsonl: cannot be written: No space left"):
        run.append("metrics.jsonl", {"episode": 2})
    monkeypatch.undo()
    assert run.lines() == [{"episode": 1}]
    assert (tmp_path / "metrics.jsonl").read_text() == '{"episode": 1}\n'
