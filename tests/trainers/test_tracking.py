"""Tests what trackers record, by reading their files, and that their failures end no training."""

import csv
import importlib
import json
import os
import socket
import struct
import warnings
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import wandb
from refusal import refused
from wandb.proto import wandb_internal_pb2

from emberlink import trainers
from emberlink.envs.utils import errors
from emberlink.trainers import tracking
from emberlink.trainers.cli import main
from emberlink.trainers.config.compose import resolve, to_values
from emberlink.trainers.runs.run_folder import RunFolder
from emberlink.trainers.training.trainer import Trainer

EPISODES = 4
SHORT = {
    "setup": "tuned",
    "seed": 3,
    "episodes": EPISODES,
    "env.horizon": 8,
    "env.num_uavs": 2,
    "num_envs": 2,
    "fire": "paper",
    "learner.hidden": [8, 8],
    "learner.batch_size": 8,
    "evaluation.interval": 2,
    "evaluation.interval_episodes": 1,
    "evaluation.episodes": 1,
    "evaluation.scripted": [],
}
ARGUMENTS = [f"{key}={value}" for key, value in SHORT.items()]


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path, monkeypatch):
    """Runs tests in an empty folder, without network and without settings of the user."""
    monkeypatch.chdir(tmp_path)
    for name in ("WANDB_CACHE_DIR", "WANDB_CONFIG_DIR", "WANDB_DATA_DIR"):
        monkeypatch.setenv(name, str(tmp_path.parent / f"{tmp_path.name}-wandb"))
    for name in ("MODE", "API_KEY", "BASE_URL", "PROJECT", "SILENT", "RUN_ID", "NAME", "RUN_GROUP"):
        monkeypatch.delenv(f"WANDB_{name}", raising=False)
    connect = socket.socket.connect

    def local_only(self, address):
        host = address[0] if isinstance(address, tuple) else "local"
        assert host in ("local", "127.0.0.1", "::1", "localhost"), address
        return connect(self, address)

    monkeypatch.setattr(socket.socket, "connect", local_only)
    forget()
    yield
    forget()


def forget() -> None:
    """Resets wandb, which reads its settings once per process."""
    with suppress(Exception):
        wandb.teardown()
    os.environ.pop("WANDB_SERVICE", None)


def command(logger: str, *more: str) -> RunFolder:
    """Trains by the command and returns the run."""
    arguments = ["train", "independent", *ARGUMENTS, f"logger={logger}", "output=runs", *more]
    assert main.main(arguments) == 0
    (folder,) = Path("runs").iterdir()
    return RunFolder(folder)


def means(run: RunFolder) -> dict[str, float]:
    results = json.loads((run.path / "eval.json").read_text())["results"]
    return {
        f"test/{fire}/{name}": sum(values) / len(values)
        for fire, by_policy in results.items()
        for name, values in by_policy["learned"].items()
    }


def figures(run: RunFolder, *kinds: str) -> set[str]:
    files = (run.path / "figures").iterdir()
    return {f"figures/{file.stem}" for file in files if file.suffix in kinds}


def sections(line: dict[str, Any]) -> dict[str, Any]:
    return {f"{'validation' if '/' in n else 'training'}/{n}": v for n, v in line.items()}


def events_of(run: RunFolder) -> Any:
    reader = importlib.import_module("tensorboard.backend.event_processing.event_accumulator")
    events = reader.EventAccumulator(str(run.path / "tensorboard"))
    events.Reload()
    return events


def scalars(run: RunFolder) -> dict[str, dict[int, float]]:
    events = events_of(run)
    return {
        name: {event.step: event.value for event in events.Scalars(name)}
        for name in events.Tags()["scalars"]
    }


def expected(run: RunFolder) -> dict[str, Any]:
    """Returns the episodes and the evaluation of a run, name -> step -> approximate number."""
    lines = [{**sections(line), "episode": line["episode"]} for line in run.metrics()]
    names = {name for line in lines for name in line if name != "episode"}
    table = {n: {line["episode"]: line[n] for line in lines if n in line} for n in names}
    table |= {name: {len(lines): value} for name, value in means(run).items()}
    return {name: pytest.approx(values, rel=1e-6) for name, values in table.items()}


def written(run: RunFolder) -> Iterator[wandb_internal_pb2.Record]:
    """Yields the records of a run's .wandb files, which have LevelDB's log format."""
    for file in sorted(run.path.rglob("*.wandb")):
        data, at, whole = file.read_bytes(), 7, b""
        while at + 7 <= len(data):
            if (left := 32768 - at % 32768) < 7:  # the rest of a block is padding
                at += left
                continue
            _, length, kind = struct.unpack("<IHB", data[at : at + 7])
            whole += data[at + 7 : at + 7 + length]
            at += 7 + length
            if kind in (1, 4):  # complete, or the last part
                yield wandb_internal_pb2.Record.FromString(whole)
                whole = b""


def rows_of(run: RunFolder) -> list[dict[str, object]]:
    """Returns the history of a wandb run in the order of logging."""
    return [
        {item.nested_key[0] or item.key: json.loads(item.value_json) for item in r.history.item}
        for r in written(run)
        if r.HasField("history")
    ]


def summary_of(run: RunFolder) -> dict[str, object]:
    updates = [u for r in written(run) if r.HasField("summary") for u in r.summary.update]
    return {u.key or "/".join(u.nested_key): json.loads(u.value_json) for u in updates}


def test_wandb_has_every_episode_and_the_evaluation_in_its_summary(capfd):
    run = command("wandb")
    printed = capfd.readouterr()
    assert "wandb" not in printed.out + printed.err
    assert "WANDB_MODE" not in os.environ
    history = rows_of(run)
    assert [row["_step"] for row in history] == [1, 2, 3, 4]
    for row, line in zip(history, run.metrics(), strict=True):
        assert {k: v for k, v in row.items() if not k.startswith("_")} == sections(line)
    summary = summary_of(run)
    assert means(run).items() <= summary.items()
    assert figures(run, ".png", ".gif") <= summary.keys()
    (about,) = (record.run for record in written(run) if record.HasField("run"))
    assert about.project == "emberlink"
    assert about.run_group == "tuned-paper"
    assert sorted(about.tags) == ["independent", "seed-3"]
    updates = [u for r in written(run) if r.HasField("config") for u in r.config.update]
    settings = {u.key: json.loads(u.value_json) for u in updates if u.key != "_wandb"}
    assert settings == json.loads(json.dumps(to_values(run.config())))
    # The axis continues in the same run.
    assert main.main(["train", f"resume={run.path}", "episodes=6"]) == 0
    assert [row["_step"] for row in rows_of(run)] == [1, 2, 3, 4, 5, 6]
    assert len({file.stem for file in run.path.rglob("*.wandb")}) == 1
    assert means(run).items() <= summary_of(run).items()


def test_the_id_and_the_mode_of_the_caller_are_respected(monkeypatch):
    monkeypatch.setenv("WANDB_RUN_ID", "run-of-mine")
    monkeypatch.setenv("WANDB_NAME", "mine")
    monkeypatch.setenv("WANDB_MODE", "offline")
    run = command("wandb")
    names = {r.run.display_name for r in written(run) if r.HasField("run")}
    assert names == {"mine"}
    assert {file.name for file in run.path.rglob("*.wandb")} == {"run-run-of-mine.wandb"}
    monkeypatch.setenv("WANDB_MODE", "disabled")
    Path("runs").rename("before")
    assert not [*command("wandb").path.rglob("*.wandb")]


def tables(run: RunFolder) -> dict[str, dict[int, float]]:
    """Returns the numbers of the CSV logger."""
    folder = run.path / "csv" / "scalars"
    return {
        file.relative_to(folder).with_suffix("").as_posix(): {
            int(step): float(value) for step, value in csv.reader(file.open())
        }
        for file in folder.rglob("*.csv")
    }


@pytest.mark.parametrize(("logger", "numbers"), [("tensorboard", scalars), ("csv", tables)])
def test_every_number_is_written_and_written_again_by_a_resume(logger, numbers):
    run = command(logger)
    assert numbers(run) == expected(run)
    if logger == "tensorboard":
        assert set(events_of(run).Tags()["images"]) == figures(run, ".png")
    trainers.resume(run.path, episodes=6)
    assert numbers(run) == expected(run)
    assert numbers(run)["training/coverage"].keys() == {1, 2, 3, 4, 5, 6}


def train(logger: str, folder: Path):
    """Trains to the end and returns the warnings about the tracker."""
    settings = [*ARGUMENTS, "evaluation.interval=0", f"logger={logger}", f"output={folder}"]
    trainer = Trainer(resolve("independent", settings))
    run = trainer.start()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert trainer.train()
        trainer.close()
    assert [line["episode"] for line in run.metrics()] == [1, 2, 3, 4]
    assert run.step() == EPISODES * 8
    return [str(warning.message) for warning in caught if "logger=" in str(warning.message)]


FULL, LEFT = OSError("No space\nleft on device\nnone at all"), SystemExit(1)


@pytest.mark.parametrize(("stage", "error"), [("init", LEFT), ("log", FULL), ("finish", FULL)])
def test_a_tracker_that_fails(stage, error, tmp_path, monkeypatch):
    class Fragile:
        def __init__(self, *_: Any):
            self.experiment, self.told = self, 0
            self.at("init")

        def at(self, now: str) -> None:
            if now == stage:
                raise error

        def log_metrics(self, _: dict, step: int) -> None:
            self.told += 1
            self.at("log")
            assert stage != "log" or self.told == 1  # no calls after the failure

        def close(self) -> None:
            self.at("finish")

    monkeypatch.setattr(tracking, "_files", Fragile)
    (message,) = train("csv", tmp_path)
    assert ("No space left" if error is FULL else "SystemExit") in message
    assert "\n" not in message


def test_a_missing_package_is_an_error_before_training(monkeypatch, capsys):
    monkeypatch.setattr(errors, "find_spec", lambda name: None)
    said = "logger=tensorboard: tensorboard is not installed: pip install"
    refused(["train", "independent", *ARGUMENTS, "logger=tensorboard"], capsys, said)
    assert not Path("runs").exists()
