"""Tests the output and the files of the commands."""

import json

import pytest
from tiny_run import TINY

from emberlink.trainers.cli import main
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.runs import checkpoint
from emberlink.trainers.runs.run_folder import RunFolder

POLICIES = resolve("consensus").evaluation.scripted


@pytest.mark.drawn
def test_train_writes_its_files_and_prints_the_table(tmp_path, capsys):
    output = tmp_path / "some where" / "deep"
    assert main.main(["train", "independent", *TINY, f"output={output}"]) == 0
    out, _ = capsys.readouterr()
    (folder,) = output.iterdir()
    assert out.rstrip().splitlines()[-1] == str(folder)
    assert {"test", "fires:", "huygens", *POLICIES} <= set(out.split())
    results = json.loads((folder / "eval.json").read_text())["results"]
    for by_policy in results.values():
        assert list(by_policy) == ["learned", *POLICIES]
    (animation,) = (folder / "figures").glob("*.gif")
    assert animation.read_bytes()[:6] == b"GIF89a"
    assert len((folder / "metrics.jsonl").read_text().splitlines()) == 2
    assert {file.stem for file in folder.glob("*.safetensors")} == {"checkpoint", "best"}
    assert (folder / "figures" / "training.png").stat().st_size > 1000


def test_eval_uses_the_given_checkpoint(run, capsys):
    newest = (run / "eval.json").read_bytes()
    trained = json.loads(newest)["results"]["huygens"]
    file = RunFolder(run).newest
    header, weights = checkpoint.read_header(file), checkpoint.read_tensors(file)
    moved = "/actor_network_params.module.action.bias"
    changed = {name: value + 9 * name.endswith(moved) for name, value in weights.items()}
    checkpoint.write(run / "other.safetensors", header, changed)
    assert main.main(["eval", str(run), "--checkpoint", str(run / "other.safetensors")]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == str(run)
    again = json.loads((run / "eval_other.json").read_text())
    assert again["checkpoint"] == "other.safetensors"
    again = again["results"]["huygens"]
    assert again["random_waypoints"] == trained["random_waypoints"]
    assert min(again["learned"]["boundary_exits"]) > max(trained["learned"]["boundary_exits"])
    # The evaluation of the newest checkpoint still exists.
    assert (run / "eval.json").read_bytes() == newest
    for figure in ("replay_other.html", "timelapse_huygens_other.png"):
        assert (run / "figures" / figure).exists()


def test_an_internal_error_keeps_its_traceback(monkeypatch):
    def fail(*_):
        raise ValueError("zip() argument 2 is longer than argument 1")

    monkeypatch.setattr("emberlink.trainers.training.command.resolve", fail)
    with pytest.raises(ValueError, match="longer than"):
        main.main(["train", "independent"])
