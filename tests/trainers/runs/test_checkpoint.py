"""Tests that checkpoints are written atomically and damaged checkpoints are refused."""

import errno
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from damage import damage_trials, sealed_again, without_a_seal
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import save_file
from soak import readable
from test_recipes import METHODS
from test_resume import until

from emberlink.trainers.cli import main
from emberlink.trainers.runs import checkpoint_file
from emberlink.trainers.runs.run_folder import RunFolder
from emberlink.trainers.training.resume import resume


@settings(max_examples=30, deadline=None)
@given(
    st.dictionaries(st.text("abc./_", min_size=1), st.integers(0, 4), max_size=4),
    st.dictionaries(st.text(min_size=1), st.floats(allow_nan=False) | st.text()),
)
def test_write_and_read_round_trip(tmp_path_factory, sizes, header):
    path = tmp_path_factory.mktemp("checkpoint") / "one.safetensors"
    content = {name: torch.randn(size) for name, size in sizes.items()}
    expected = {key: value for key, value in header.items() if key not in ("sha256", "format")}
    checkpoint_file.write(path, content, expected)
    header_read, tensors = checkpoint_file.read(path)
    assert {k: v for k, v in header_read.items() if k not in ("sha256", "format")} == expected
    assert tensors.keys() == content.keys()
    assert all(tensors[name].equal(value) for name, value in content.items())
    assert [file.name for file in path.parent.iterdir()] == [path.name]


def test_a_change_of_any_byte_is_detected(tmp_path):
    path = tmp_path / "one.safetensors"
    checkpoint_file.write(path, {"a": torch.arange(5.0)}, {"kind": "networks", "step": 3})
    sound = path.read_bytes()
    for place in range(len(sound)):
        flipped = bytearray(sound)
        flipped[place] ^= 1 << place % 8
        path.write_bytes(flipped)
        with pytest.raises(ValueError, match=r"one\.safetensors"):
            checkpoint_file.read(path)
    for length in range(len(sound)):
        path.write_bytes(sound[:length])
        with pytest.raises(ValueError, match=r"one\.safetensors"):
            checkpoint_file.read(path)


@pytest.mark.slow
@pytest.mark.parametrize(
    "method",
    ["consensus", *(pytest.param(m, marks=pytest.mark.heavy) for m in METHODS if m != "consensus")],
)
def test_damaged_and_foreign_checkpoints_are_refused(method, tmp_path):
    files = readable(tmp_path, method)
    done, failures = damage_trials(files, 28, METHODS.index(method))
    assert done == 28
    assert failures == []


def test_a_state_without_a_seal_is_refused_and_the_previous_state_is_named(tmp_path, capsys):
    (path, _), _ = readable(tmp_path, "consensus")
    run = RunFolder(path.parent.parent)
    assert len(run.states()) == 2
    without_a_seal(path, None)  # pyright: ignore[reportArgumentType]
    before = {file: file.read_bytes() for file in run.path.rglob("*") if file.is_file()}
    assert main.main(["train", f"resume={run.path}"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert f"the one before it: emberlink train resume={run.states()[0]}" in error
    assert before == {file: file.read_bytes() for file in run.path.rglob("*") if file.is_file()}
    trainer = resume(run.states()[0])
    assert trainer.setup.step == 30
    assert not path.exists()
    until(trainer, None)
    with pytest.raises(ValueError, match="nothing can be resumed from it"):
        resume(run.checkpoint())


@pytest.fixture(scope="module")
def _stopped(tmp_path_factory) -> Path:
    (path, _), _ = readable(tmp_path_factory.mktemp("stopped"), "consensus")
    return path.parent.parent


@pytest.fixture
def stopped(_stopped, tmp_path) -> Path:
    """Returns the newest state of a copied run: step 33 of 2 environments, 12 steps an episode."""
    run = RunFolder(shutil.copytree(_stopped, tmp_path / "run"))
    return run.states()[-1]


def refused(path: Path, change: Callable[[dict, dict[str, torch.Tensor]], object]) -> str:
    """Changes header and tensors of a state, seals it again and returns the error on reading."""
    sound = path.read_bytes()
    sealed_again(path, change)
    with pytest.raises(ValueError, match=r"^.*/state_\d+\.safetensors: ") as error:
        resume(path)
    path.write_bytes(sound)
    text = str(error.value)
    assert "\n" not in text
    assert len(text.replace(str(path.parent.parent), "")) < 300
    return text.partition("; the one before it")[0].removeprefix(f"{path}: ")


@pytest.mark.heavy
def test_nan_in_any_tensor_is_refused(stopped):
    _, content = checkpoint_file.read(stopped)
    floating = [name for name, value in content.items() if value.is_floating_point()]
    assert {name.partition("/")[0] for name in floating} == {
        *("learner", "carried", "environments", "communication", "episode")
    }
    networks = "learner/networks/", "learner/optimizer/"
    others = [n for n in floating if not n.startswith(networks) and "arrival_time" not in n]
    bias = "learner/networks/actor_network_params.module.first.bias"
    for name in [*others, bias, "learner/optimizer/0.step"]:
        for bad in (float("nan"), float("inf")):

            def change(_, content: dict, name: str = name, bad: float = bad) -> None:
                values = content[name].view(-1)
                values[values.isfinite().nonzero()[-1]] = bad

            assert name in refused(stopped, change)


@pytest.mark.slow
@pytest.mark.parametrize("group", ["learner/networks", "learner/replay", "environments", "episode"])
def test_a_state_with_an_extra_or_missing_tensor_is_refused(group, stopped):
    _, content = checkpoint_file.read(stopped)
    name = next(name for name in content if name.startswith(group))
    reason = refused(stopped, lambda _, content: content.pop(name))
    assert reason == f"holds {len(content) - 1} tensors; expected {len(content)}"
    reason = refused(stopped, lambda _, content: content.update({f"{group}/x": torch.ones(2)}))
    assert reason == f"holds {len(content) + 1} tensors; expected {len(content)}"


def test_a_tensor_of_another_shape_is_refused(stopped):
    name = "learner/networks/actor_network_params.module.first.bias"
    reason = refused(stopped, lambda _, content: content.update({name: torch.ones(2, 1, 5)}))
    assert reason.startswith("does not fit this training: tensor actor_network_params.module.first")


STATE_KEYS = ["folders", "sizes", "best", "seconds", "step", "rollbacks", "versions"]


@pytest.mark.parametrize("key", STATE_KEYS)
def test_a_header_that_lacks_a_key_is_refused(key, stopped):
    reason = refused(stopped, lambda header, _: header.pop(key))
    assert reason == f"a checkpoint of another version: it has no '{key}'"


@pytest.mark.parametrize(
    ("key", "value"),
    [
        *(("step", value) for value in ("x", None, -1, 0.5, True)),
        *(("best", value) for value in (None, ["x"], [], [1.0, 2.0], [float("nan")])),
        *(("seconds", value) for value in ("x", -1.0, float("inf"))),
        *(("sizes", value) for value in ([], [{}], None, [{"metrics.jsonl": "1"}], [{"a": 0}])),
        *(("rollbacks", {"lr_scale": value}) for value in ("x", 0.0, 2.0, float("nan"))),
        *(("rollbacks", value) for value in ([], {"count": -1}, {"more": 1})),
        *(("folders", value) for value in (3, [], ["a", "b"])),
        ("versions", []),
        ("config", "x" * 200_000),
    ],
)
def test_a_header_with_a_wrong_value_is_refused(key, value, stopped):
    refused(stopped, lambda header, _: header.update({key: value}))


@pytest.mark.parametrize("key", ["learner.gamma", "env.horizon", "seed"])
def test_a_state_of_another_configuration_is_refused(key, stopped):
    def change(header: dict, _) -> None:
        *path, last = key.split(".")
        values = header["config"]
        for part in path:
            values = values[part]
        values[last] = {"gamma": 0.5, "horizon": 13, "seed": 5}[last]

    assert refused(stopped, change).startswith(f"made with {key}=")


def test_the_previous_state_is_an_earlier_one(stopped):
    """States of the same step under another name and later states are not named."""
    run = RunFolder(stopped.parent.parent)
    first, last = run.states()
    copy = Path(shutil.copy(last, last.with_name("state_x.safetensors")))
    for path, named in ((last, first), (first, None), (copy, None)):
        without_a_seal(path, None)  # pyright: ignore[reportArgumentType]
        with pytest.raises(ValueError, match="not a readable checkpoint") as error:
            resume(path)
        _, _, hint = str(error.value).partition("the one before it: emberlink train resume=")
        assert hint == (str(named) if named else "")


def test_a_header_without_a_checksum_is_refused(tmp_path):
    path = tmp_path / "one.safetensors"
    header = json.dumps({"sha256": "", "format": checkpoint_file.FORMAT})
    save_file({"a": torch.ones(3)}, path, metadata={"emberlink": header})
    with pytest.raises(ValueError, match="its SHA-256 is wrong"):
        checkpoint_file.read(path)


def test_networks_alone_cannot_be_resumed(run, capsys):
    for state in RunFolder(run).states():
        state.unlink()
    assert main.main(["train", f"resume={run}"]) == 2
    assert "holds networks alone" in capsys.readouterr().err


@pytest.mark.parametrize("part", ["save_file", "fsync", "replace"])
def test_a_failed_save_keeps_the_existing_file(part, tmp_path, monkeypatch):
    path = tmp_path / "one.safetensors"
    checkpoint_file.write(path, {"a": torch.ones(3)}, {})
    before = path.read_bytes()

    def full(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(
        {"save_file": checkpoint_file, "fsync": os, "replace": Path}[part], part, full
    )
    with pytest.raises(ValueError, match=r"one\.safetensors: cannot be written: No space left"):
        checkpoint_file.write(path, {"a": torch.zeros(3)}, {})
    monkeypatch.undo()
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_a_file_is_flushed_before_it_is_renamed(tmp_path, monkeypatch):
    """The order is: flush of the file, rename, flush of the folder."""
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
    checkpoint_file.write(path, {"a": torch.ones(3)}, {})
    assert done == [f"{path}.{os.getpid()}.part", "rename", str(path.parent)]


def test_a_line_is_written_completely_or_not_at_all(tmp_path, monkeypatch):
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
