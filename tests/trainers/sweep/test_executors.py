"""Tests the executors without a cluster; tests/cluster has the rest."""

import os
import subprocess
from dataclasses import fields
from types import SimpleNamespace

from emberlink.envs.utils.config_files import known as known_files
from emberlink.envs.utils.config_files import read
from emberlink.trainers.sweep.executors.base import EXECUTORS, Task
from emberlink.trainers.sweep.executors.local import LocalConfig, LocalExecutor


def test_every_executor_has_a_file_with_its_settings():
    assert EXECUTORS.known() == known_files("executor") == ["local", "ray", "submitit"]
    for name in EXECUTORS.known():
        keys = {field.name for field in fields(EXECUTORS.find(name).config_type)}
        assert keys == {*read("executor", name)} - {"name"}


def test_a_task_sees_its_share_of_threads_and_gpus(tmp_path, monkeypatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "4,7")
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {*range(8)})
    seen = []
    monkeypatch.setattr(
        subprocess,
        "Popen",
        lambda command, env, **_: seen.append(env) or SimpleNamespace(poll=lambda: None),
    )
    task = Task(tmp_path, (), tmp_path / "log.txt")
    executor = LocalExecutor(LocalConfig(workers=4, gpus=2))
    executor.submit([task] * 4)
    assert [env["OMP_NUM_THREADS"] for env in seen] == ["2"] * 4
    assert [env["CUDA_VISIBLE_DEVICES"] for env in seen] == ["4", "7", "4", "7"]
