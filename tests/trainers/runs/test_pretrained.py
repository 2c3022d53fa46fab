"""Tests trained policies that are shipped with emberlink."""

import json
import runpy
import shutil
import tarfile
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from refusal import refused
from tiny_run import TINY

from emberlink.trainers.cli.main import main
from emberlink.trainers.config.compose import flat, to_values
from emberlink.trainers.evaluation.policy import load_actor
from emberlink.trainers.runs import checkpoint, pretrained
from emberlink.trainers.runs.run_folder import RunFolder

PACKED = (("consensus", 3, "paper"), ("positional", 1, "front"))
FOLDERS = ("tuned/consensus/s3", "tuned_front/positional/s1")

SCRIPT = Path(__file__).parents[3] / "docs/experiments/pack_policies.py"
FILES = ("checkpoint.safetensors", "config.yaml")
packed_in = runpy.run_path(str(SCRIPT))["main"]


@pytest.fixture(scope="module")
def packed(tmp_path_factory) -> tuple[Path, list[Path]]:
    """Packs a run, with copies as of another seed and method, and one of another world."""
    folder = tmp_path_factory.mktemp("packed")
    root, runs = folder / "shipped", []
    for method, seed, world in PACKED:
        output = folder / f"{method}{seed}"
        arguments = [method, "setup=tuned", f"world={world}", *TINY, f"seed={seed}"]
        arguments += [f"output={output}", "evaluation.scripted=[]"]
        assert main(["train", *arguments]) == 0
        (run,) = output.iterdir()
        runs.append(run)
    for run, place in zip(runs, FOLDERS, strict=True):
        packed_in(str(run), str((root / place).parent))
    for name in ("consensus/s10", "independent/s3"):
        shutil.copytree(root / FOLDERS[0], root / "tuned" / name)
    return root, runs


def test_seeds_are_added_to_an_archive(packed, tmp_path):
    archive, read = tmp_path / "arm.tar.xz", []
    for run in packed[1]:
        packed_in(str(run), str(archive))
        with tarfile.open(archive) as members:
            files: Any = [(file.name, members.extractfile(file)) for file in members]
            read.append({name: file.read() for name, file in files if file})
    names = [f"arm/s{seed}/{file}" for seed in (1, 3) for file in FILES]
    assert [sorted(content) for content in read] == [names[2:], names]
    assert read[1].items() >= read[0].items()
    with pytest.raises(FileExistsError):
        packed_in(str(packed[1][0]), str(archive))


@pytest.fixture
def shipped(packed, tmp_path, monkeypatch) -> Path:
    """Installs the packed policies as shipped ones and changes to an empty folder."""
    root, _ = packed
    monkeypatch.setattr(pretrained, "_shipped", lambda: root)
    monkeypatch.chdir(tmp_path)
    return root


def test_packed_runs_omit_the_training_state(packed):
    root, runs = packed
    for run, place in zip(runs, FOLDERS, strict=True):
        mine = root / place
        files = {file.relative_to(mine).as_posix() for file in mine.rglob("*") if file.is_file()}
        assert files == {"config.yaml", "metrics.jsonl", "eval.json", "checkpoint.safetensors"}
        assert not checkpoint.read_header(mine / "checkpoint.safetensors").resumable
        for file in ("metrics.jsonl", "eval.json"):
            assert (mine / file).read_bytes() == (run / file).read_bytes()
        values = yaml.safe_load((mine / "config.yaml").read_text())
        assert values["output"] == "runs"  # no local paths
        assert str(run.parent) not in (mine / "config.yaml").read_text()
        config = RunFolder(run).config()
        trained_actor, packed_actor = (
            load_actor(config, RunFolder(path).newest) for path in (run, mine)
        )
        for name, weight in trained_actor.state_dict().items():
            assert weight.equal(packed_actor.state_dict()[name])


def test_a_name_replaces_a_run_folder(shipped, tmp_path, capsys):
    assert main(["eval", "pretrained:consensus"]) == 0
    folder = tmp_path / "runs" / "pretrained_tuned_consensus_s3"
    assert [path.name for path in (tmp_path / "runs").iterdir()] == [folder.name]
    made, given = (
        json.loads((path / "eval.json").read_text())
        for path in (folder, shipped / "tuned" / "consensus" / "s3")
    )
    assert made == given  # the same fires, the same numbers
    assert (folder / "figures" / "training.png").exists()
    assert main(["render", "pretrained:tuned/consensus/10", "pretrained:independent"]) == 0
    printed = capsys.readouterr().out
    assert "pretrained_tuned_consensus_s10/figures/side_by_side" in printed.replace("\n", "")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["eval", "{}", "policy.hold=5"], "policy.hold"),
        (["eval", "{}", "world=moon"], "world 'moon'"),
        (["render", "{}", "{}", "env.num_uavs=5"], "does not fit env.num_uavs=5 (in training 2)"),
        (["eval", "pretrained:consensos"], "tuned/independent/s3, tuned_front/positional/s1"),
        (["render", "pretrained:tuned"], "is ambiguous"),
        (["eval", "pretrained:"], "no such trained policy"),
    ],
)
def test_what_is_refused_leaves_no_copy(shipped, tmp_path, capsys, arguments, message):
    given = [text.format("pretrained:tuned/consensus/s3") for text in arguments]
    refused(given, capsys, message)
    assert not (tmp_path / "runs").exists()


def test_names_of_several_policies(shipped):
    def names(text: str) -> list[str]:
        return ["/".join(path.parts[-2:]) for path in pretrained.find(text)]

    assert names("pretrained:tuned") == ["consensus/s3", "consensus/s10", "independent/s3"]
    assert names("pretrained:consensus") == ["consensus/s3", "consensus/s10"]
    assert names("pretrained:tuned/consensus/10") == ["consensus/s10"]
    assert names("pretrained:tuned_front") == ["positional/s1"]
    assert names("pretrained:positional") == ["positional/s1"]  # tuned has none


def test_every_shipped_policy_loads():
    folders = sorted(file.parent for file in pretrained._shipped().glob("*/*/*/config.yaml"))
    assert folders
    for folder in folders:
        run = RunFolder(folder)
        config = run.config()
        assert folder.name == f"s{config.seed}"
        actor = load_actor(config, run.newest)
        assert all(torch.isfinite(weight).all() for weight in actor.parameters())
        assert len(run.metrics()) == config.episodes
        evaluation = json.loads((folder / "eval.json").read_text())
        assert evaluation["fires"] >= 100
        assert run.evaluated()
        shipped, now = flat(run.values()), flat(to_values(config)) | {"output": "runs"}
        assert {key: now[key] for key in shipped} == shipped  # without keys that have gone since
