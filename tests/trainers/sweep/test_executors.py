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
from emberlink.trainers.sweep.executors import base, submitit
from emberlink.trainers.sweep.executors.base import EXECUTORS, Task, make
from emberlink.trainers.sweep.executors.local import LocalConfig, LocalExecutor


def test_every_executor_has_a_file_with_its_settings():
    assert EXECUTORS.known() == known_files("executor") == ["local", "ray", "submitit"]
    for name in EXECUTORS.known():
        keys = {field.name for field in fields(EXECUTORS.find(name).config_type)}
        assert keys == {*read("executor", name)} - {"name"}


def test_importing_an_executor_imports_no_package_of_an_extra():
    code = (
        "import sys; from emberlink.trainers.sweep.executors import ray, submitit; "
        "print([name for name in ('ray', 'submitit') if name in sys.modules])"
    )
    assert subprocess.check_output([sys.executable, "-c", code], text=True) == "[]\n"


def test_settings_that_are_texts_keep_their_form(monkeypatch):
    monkeypatch.setattr(submitit, "require", lambda *_: None)
    texts = ["account=007", "memory=4G", "options.qos=low", "partition=12", "workers=9"]
    made = make(["executor=submitit", *(f"executor.{text}" for text in texts)])
    assert isinstance(made, submitit.SubmititExecutor)
    config = made._config
    assert (config.account, config.memory, config.partition) == ("007", "4G", "12")
    assert (config.options, made.workers) == ({"qos": "low"}, 9)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["executor=submitit", "executor.time=soon"], 'executor.time="soon": should be a valid'),
        (["executor=submitit", "executor.time=2"], "executor.notice=90: executor.time=2 must be"),
        (["executor=slurm"], "executor='slurm' is not known; known: local"),
        (["executor.workers=0"], "executor.workers=0"),
        (["executor.nodes=2"], "'executor.nodes' is not known"),
        (["executor=submitit", "executor.cluster=here"], 'executor.cluster="here"'),
        (["executor=submitit"], "submitit: not installed: pip install '.[slurm]'"),
        (["executor=ray"], "ray: not installed: pip install '.[ray]'"),
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
