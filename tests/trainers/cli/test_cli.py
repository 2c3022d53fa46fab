"""Tests the output and the files of the commands."""

import json
import shutil
from pathlib import Path

import pytest
from tiny_run import TINY

from emberlink.envs import metrics
from emberlink.trainers.cli import main
from emberlink.trainers.config.compose import resolve
from emberlink.trainers.runs import checkpoint
from emberlink.trainers.runs.run_folder import RunFolder

POLICIES = resolve("consensus").evaluation.scripted


@pytest.mark.parametrize("arguments", [["trane"], ["train"], ["eval"], ["eval", "x", "--fires=0"]])
def test_usage_errors_name_the_cause(arguments, capsys):
    with pytest.raises(SystemExit) as ended:
        main.main(arguments)
    assert ended.value.code == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("emberlink")
    assert err.count("\n") == 1
    assert "--help" in err


@pytest.mark.parametrize("command", ["train", "eval", "doctor"])
def test_help_has_a_description_and_an_example(command, capsys):
    with pytest.raises(SystemExit) as ended:
        main.main([command, "--help"])
    assert ended.value.code == 0
    text = capsys.readouterr().out
    assert f"example:\n  emberlink {command}" in text
    assert len(text.split("\n\n")[1]) > 60  # the paragraph of the description
    with pytest.raises(SystemExit):
        main.main(["--help"])
    assert f"\n    {command}" in capsys.readouterr().out


@pytest.mark.drawn
def test_train_writes_its_files_and_prints_the_table(tmp_path, capsys):
    output = tmp_path / "some where" / "deep"
    assert main.main(["train", "independent", *TINY, f"output={output}"]) == 0
    out, _ = capsys.readouterr()
    (folder,) = output.iterdir()
    check_evaluation(folder, out)
    assert len((folder / "metrics.jsonl").read_text().splitlines()) == 2
    assert {file.stem for file in folder.glob("*.safetensors")} == {"checkpoint", "best"}
    assert (folder / "figures" / "training.png").stat().st_size > 1000


def check_evaluation(folder: Path, out: str, *, episodes: int = 2) -> None:
    """Checks that table and path are printed and the files of the evaluation exist."""
    assert out.rstrip().splitlines()[-1] == str(folder)
    words = set(out.split())
    assert {word for name in metrics.NAMES for word in name.split("_")} <= words
    assert set(POLICIES) <= words
    assert "test fires: huygens" in out
    results = json.loads((folder / "eval.json").read_text())["results"]
    for by_policy in results.values():
        assert list(by_policy) == ["learned", *POLICIES]
        for measured in by_policy.values():
            assert measured.keys() == set(metrics.NAMES)
            assert {len(values) for values in measured.values()} == {episodes}
    (animation,) = (folder / "figures").glob("*.gif")
    assert animation.read_bytes()[:6] == b"GIF89a"


@pytest.mark.drawn
def test_eval_repeats_the_evaluation_of_train(run, capsys):
    trained = json.loads((run / "eval.json").read_text())["results"]
    shutil.rmtree(run / "figures")
    (run / "eval.json").unlink()
    assert main.main(["eval", str(run)]) == 0
    check_evaluation(run, capsys.readouterr().out)
    assert json.loads((run / "eval.json").read_text())["results"] == trained
    assert main.main(["eval", str(run), "--fires", "1", "--device", "cpu"]) == 0
    check_evaluation(run, capsys.readouterr().out, episodes=1)


def test_eval_uses_the_given_checkpoint(run, capsys):
    newest = (run / "eval.json").read_bytes()
    trained = json.loads(newest)["results"]["huygens"]
    file = RunFolder(run).checkpoint()
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
    for figure in ("coverage_other.png", "timelapse_huygens_other.png"):
        assert (run / "figures" / figure).exists()
