"""Tests that files are written completely or not at all."""

from pathlib import Path

from emberlink.envs.utils import atomic_io


def test_a_file_is_flushed_before_it_is_renamed(tmp_path, monkeypatch):
    calls, sync, replace = [], atomic_io.sync, Path.replace
    monkeypatch.setattr(atomic_io, "sync", lambda path: calls.append(path.suffix) or sync(path))
    monkeypatch.setattr(Path, "replace", lambda *paths: calls.append("renamed") or replace(*paths))
    atomic_io.write_bytes(tmp_path / "a.txt", b"new")
    assert calls == [".part", "renamed", ""]  # the folder's list of names last
