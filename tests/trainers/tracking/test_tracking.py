"""Tests the records of the trackers by reading their files."""

import csv
import importlib
import json
import socket
import struct
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from wandb.proto import wandb_internal_pb2

from emberlink.trainers.cli import main
from emberlink.trainers.config.compose import resolve, to_values
from emberlink.trainers.training.trainer import Trainer

SHORT = [
    *("setup=tuned", "seed=3", "episodes=4", "env.horizon=12", "env.num_uavs=2", "num_envs=2"),
    *("learner.hidden=[8,8]", "learner.batch_size=16"),
    *("evaluation.interval=2", "evaluation.interval_episodes=1"),
]


def tracked(logger: str, folder: Path):
    """Returns a trained run's folder, configuration, and lines of metrics.jsonl."""
    config = resolve("consensus", [*SHORT, f"logger={logger}", f"output={folder / 'runs'}"])
    trainer = Trainer(config)
    run = trainer.start()
    trainer.train()
    lines = run.lines()
    assert [line["episode"] for line in lines] == [1, 2, 3, 4]
    assert "huygens/coverage" in lines[1]
    assert [path.name for path in folder.iterdir()] == ["runs"]
    return run.path, config, lines


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path, monkeypatch):
    """Runs tests in an empty folder, without network and without settings of the user."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("WANDB_CACHE_DIR", str(tmp_path.parent / f"{tmp_path.name}-cache"))
    monkeypatch.setenv("WANDB_CONFIG_DIR", str(tmp_path.parent / f"{tmp_path.name}-config"))
    # Set and deleted, so that values set by the run are removed at the end as well.
    for name in ("WANDB_MODE", "WANDB_API_KEY", "WANDB_PROJECT", "WANDB_SILENT"):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    connect = socket.socket.connect

    def local_only(self, address):
        host = address[0] if isinstance(address, tuple) else "local"
        assert host in ("local", "127.0.0.1", "::1", "localhost"), address
        return connect(self, address)

    monkeypatch.setattr(socket.socket, "connect", local_only)


def records(file: Path) -> Iterator[wandb_internal_pb2.Record]:
    """Yields the records of a .wandb file: LevelDB's log format after a header of 7 bytes."""
    data, at, whole = file.read_bytes(), 7, b""
    assert data[:4] in (b":W&B", b"")
    while at + 7 <= len(data):
        left = 32768 - at % 32768
        if left < 7:  # no space for a header: the rest of the block is padding
            at += left
            continue
        _, length, kind = struct.unpack("<IHB", data[at : at + 7])
        if at + 7 + length > len(data):  # still being written
            return
        whole += data[at + 7 : at + 7 + length]
        at += 7 + length
        if kind in (1, 4):  # complete, or the last part
            record = wandb_internal_pb2.Record()
            record.ParseFromString(whole)
            yield record
            whole = b""


def finished(file: Path) -> list[wandb_internal_pb2.Record]:
    """Returns all records once wandb's process has written the last one, maybe after `finish`."""
    end = time.monotonic() + 30
    while not any(record.HasField("exit") for record in records(file)):
        assert time.monotonic() < end, "the run's file was not finished"
        time.sleep(0.05)
    return list(records(file))


def read_items(items) -> dict[str, object]:
    return {item.nested_key[0] or item.key: json.loads(item.value_json) for item in items}


@pytest.mark.parametrize("mode", [None, "offline"])
def test_wandb_has_every_number_offline(mode, tmp_path, monkeypatch, capfd):
    if mode:
        monkeypatch.setenv("WANDB_MODE", mode)
    folder, config, lines = tracked("wandb", tmp_path)
    printed = capfd.readouterr()
    assert "wandb" not in printed.out + printed.err
    (file,) = folder.rglob("*.wandb")
    records_found = finished(file)
    history = [read_items(r.history.item) for r in records_found if r.HasField("history")]
    assert [row["_step"] for row in history] == [1, 2, 3, 4]
    for row, line in zip(history, lines, strict=True):
        assert {k: v for k, v in row.items() if not k.startswith("_")} == line
    (run,) = (record.run for record in records_found if record.HasField("run"))
    assert run.project == "emberlink"
    assert run.run_group == "tuned-huygens"
    assert sorted(run.tags) == ["consensus", "seed-3"]
    assert run.display_name == folder.name
    updates = [u for r in records_found if r.HasField("config") for u in r.config.update]
    settings = [(u.key, json.loads(u.value_json)) for u in updates if u.key != "_wandb"]
    assert settings == list(json.loads(json.dumps(to_values(config))).items())


def test_tensorboard_has_every_number(tmp_path):
    reader = importlib.import_module("tensorboard.backend.event_processing.event_accumulator")
    folder, _, lines = tracked("tensorboard", tmp_path)
    (file,) = folder.rglob("events.out.tfevents.*")
    events = reader.EventAccumulator(str(file))
    events.Reload()
    names = {name for line in lines for name in line}
    assert set(events.Tags()["scalars"]) == names
    for name in names:
        logged = {event.step: event.value for event in events.Scalars(name)}
        truth = {line["episode"]: line[name] for line in lines if name in line}
        assert logged == pytest.approx(truth, rel=1e-6), name


def test_csv_is_one_table_with_a_header(tmp_path):
    folder, _, lines = tracked("csv", tmp_path)
    with (folder / "metrics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert set(rows[0]) == {name for line in lines for name in line}
    for row, line in zip(rows, lines, strict=True):
        assert {name: float(value) for name, value in row.items() if value} == line
    assert not [path for path in folder.iterdir() if path.name.startswith("csv")]


def test_the_final_evaluation_reaches_tensorboard(tmp_path, capsys):
    reader = importlib.import_module("tensorboard.backend.event_processing.event_accumulator")
    assert main.main(["train", "consensus", *SHORT, *FINAL, "logger=tensorboard"]) == 0
    (folder,) = (tmp_path / "runs").iterdir()
    events = reader.EventAccumulator(str(folder / "tensorboard"))
    events.Reload()
    for name, value in final_means(folder).items():
        (event,) = events.Scalars(name)
        assert (event.step, event.value) == (4, pytest.approx(value, rel=1e-6))
    assert [event.step for event in events.Scalars("coverage")] == [1, 2, 3, 4]
    assert set(events.Tags()["images"]) == {f"figures/{f.stem}" for f in figures(folder)}


def test_the_final_evaluation_reaches_wandb(tmp_path, capsys):
    assert main.main(["train", "consensus", *SHORT, *FINAL, "logger=wandb"]) == 0
    (folder,) = (tmp_path / "runs").iterdir()
    files = sorted(folder.rglob("*.wandb"))
    assert len({file.stem for file in files}) == 1  # of a single run
    rows = [
        read_items(record.history.item)
        for file in files
        for record in finished(file)
        if record.HasField("history")
    ]
    assert [row["_step"] for row in rows] == [1, 2, 3, 4, 5]
    assert final_means(folder).items() <= rows[-1].items()
    assert {f"figures/{f.stem}" for f in figures(folder)} <= {key.split(".")[0] for key in rows[-1]}


FINAL = ["evaluation.episodes=2", "output=runs"]


def figures(folder: Path) -> list[Path]:
    figures_found = sorted((folder / "figures").glob("*.png"))
    assert len(figures_found) >= 3
    return figures_found


def final_means(folder: Path) -> dict[str, float]:
    results = json.loads((folder / "eval.json").read_text())["results"]
    return {
        f"test/{fire}/{name}": sum(values) / len(values)
        for fire, by_policy in results.items()
        for name, values in by_policy["learned"].items()
    }


def test_without_a_tracker_there_are_no_additional_files(tmp_path):
    folder, _, _ = tracked("none", tmp_path)
    files = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    expected = {"config.yaml", "metrics.jsonl", "timing.jsonl"}
    saved = ("best", "state_000000048", "step_000000048")
    assert files == expected | {f"checkpoints/{name}.safetensors" for name in saved}


def test_the_tracker_does_not_change_the_run(tmp_path):
    folders = [tmp_path / name for name in ("a", "b")]
    texts = []
    for folder, logger in zip(folders, ("none", "csv"), strict=True):
        folder.mkdir()
        path, _, _ = tracked(logger, folder)
        texts.append((path / "metrics.jsonl").read_bytes())
    assert texts[0] == texts[1]
