"""Tests the executors as far as they need no cluster; tests/cluster has the rest."""

import os
import subprocess
import sys
from dataclasses import fields
from types import SimpleNamespace

import pytest

from emberlink.envs.utils.config_files import known as known_files
from emberlink.envs.utils.config_files import read
from emberlink.trainers.cli.main import main
from emberlink.trainers.sweep.executors import base, ray, registry, submitit
from emberlink.trainers.sweep.executors.base import Task
from emberlink.trainers.sweep.executors.local import LocalConfig, LocalExecutor


def test_every_executor_has_a_file_with_its_settings():
    assert registry.known() == known_files("executor") == ["local", "ray", "submitit"]
    for name in registry.known():
        keys = {field.name for field in fields(registry.find(name).config_type)}
        assert keys == {*read("executor", name)} - {"name"}


def test_importing_an_executor_imports_no_package_of_an_extra():
    code = (
        "import sys; from emberlink.trainers.sweep.executors import ray, submitit; "
        "print([name for name in ('ray', 'submitit') if name in sys.modules])"
    )
    assert subprocess.check_output([sys.executable, "-c", code], text=True) == "[]\n"


@pytest.mark.parametrize(
    ("text", "expected"),
    [("60", 60), ("1:30", 2), ("2:00:00", 120), ("1-0", 1440), ("1-2:03:04", 1564), ("0:01", 1)],
)
def test_times_have_the_forms_of_sbatch(text, expected):
    assert submitit.minutes(text) == expected


def test_settings_that_are_texts_keep_their_form(monkeypatch):
    made = []

    class Made(submitit.SubmititExecutor):
        def __init__(self, config):
            made.append(config)

    monkeypatch.setattr(registry, "find", lambda _: Made)
    texts = ["account=007", "time=4:00:00", "memory=4G", "options.qos=low", "partition=12"]
    registry.make(["executor=submitit", *(f"executor.{text}" for text in texts)])
    (config,) = made
    assert (config.account, config.time, config.memory) == ("007", "4:00:00", "4G")
    assert (config.options, config.partition) == ({"qos": "low"}, "12")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["executor=submitit", "executor.time=soon"], "expected minutes, or H:MM:SS"),
        (["executor=submitit", "executor.time=0"], "executor.time=0: expected minutes"),
        (["executor=submitit", "executor.cluster=debug"], "executor.cluster="),
        (["executor=submitit", "executor.time=2"], "executor.notice=90: executor.time=2 must be"),
        (["executor=ray", "executor.gpus=1.5"], "executor.gpus=1.5: expected a fraction of 1 or"),
        (["executor=ray", "executor.resources.a=2.5"], "executor.resources.a=2.5: expected a"),
        (["executor=submitit"], "submitit is not installed: pip install '.[slurm]'"),
        (["executor=ray"], "ray is not installed: pip install '.[ray]'"),
    ],
)
def test_what_is_wrong_is_named_in_one_line(arguments, said, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(base, "find_spec", lambda _: None)
    assert main(["sweep", "independent", *arguments]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert not any(tmp_path.iterdir())


def test_a_folder_with_patterns_of_submitit_is_reached_through_a_link(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    plain, special = tmp_path / "plain", tmp_path / "a%j b"
    assert submitit._without_patterns(plain) == plain
    for _ in range(2):
        link = submitit._without_patterns(special)
        assert "%" not in str(link)
        assert link.resolve() == special


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


def test_a_task_does_not_import_modules_of_the_working_directory(tmp_path):
    (tmp_path / "random.py").write_text("raise RuntimeError('wrong module')\n")
    task = Task(tmp_path / "missing", (), tmp_path / "log.txt", place=tmp_path)
    assert task.start(1).wait() == 2
    assert "there is no such run folder" in task.log.read_text()


def test_a_run_that_no_node_can_take_is_told(monkeypatch):
    nodes = [{"Alive": True, "Resources": {"CPU": 2.0}}, {"Alive": False, "Resources": {"GPU": 8}}]
    fake = SimpleNamespace(
        is_initialized=lambda: False, init=lambda *_, **__: 0, nodes=lambda: nodes
    )
    monkeypatch.setattr(base, "find_spec", lambda _: True)
    monkeypatch.setattr(ray, "import_module", lambda _: fake)
    with pytest.warns(match="no node has CPU=1, GPU=1"):
        ray.RayExecutor(ray.RayConfig(gpus=1.0))._connect()
