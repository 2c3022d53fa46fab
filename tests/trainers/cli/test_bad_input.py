"""Tests that invalid input gives a one-line error, exit status 2, and no files."""

import shutil
from pathlib import Path

import pytest
import torch
import yaml
from safetensors.torch import save_file
from tiny_run import TINY

from emberlink.trainers.cli import main
from emberlink.trainers.runs.run_folder import RunFolder


def refused(arguments: list[str], capsys, *words: str) -> str:
    """Returns the one-line error of a command that exits with status 2 and checks its words."""
    capsys.readouterr()
    assert main.main(arguments) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1, err
    assert err.startswith(f"emberlink {arguments[0]}: ")
    assert len(err) < 400
    for word in words:
        assert word in err, err
    return err


METHODS = "known: consensus, independent, maps, positional, shared_memory"
SETUPS = "known: paper, released, strong, tuned"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["consensu"], ["'consensu'", "did you mean consensus?", METHODS]),
        (["zzz"], ["'zzz'", METHODS]),
        ([""], ["''", METHODS]),
        (["consensus", "learner.gama=0.9"], ["'learner.gama'", "did you mean learner.gamma?"]),
        (["consensus", "horizon=10"], ["'horizon'", "did you mean env.horizon?"]),
        (
            ["independent", "comm.jitter=5"],
            ["'comm.jitter'", "a setting of method consensus, not of independent"],
        ),
        (
            ["independent", "learner.clip=0.1"],
            ["'learner.clip'", "a setting of learner ippo, mappo, not of ddpg"],
        ),
        (["independent", "world=fornt"], ["world 'fornt'", "did you mean front?"]),
        (["independent", "env.base=[30,0]"], ["env.base=[30, 0]", "outside of the map"]),
        (["independent", "env.failures=2.5"], ["env.failures=2.5", "the team has 2 UAVs"]),
        (["independent", "fire.burn_time=0.5"], ["fire.burn_time=0.5", "greater than or equal"]),
        (["independent", "evaluation.headline=age"], ["evaluation.headline=age", "front_age"]),
        (
            ["independent", "evaluation.headline=base_age"],
            ["evaluation.headline=base_age", "is not measured in this world"],
        ),
        (["independent", "evaluation.scripted=[orcale]"], ["orcale", "did you mean oracle?"]),
        (
            ["consensus", 'env.radio.range="10"'],
            ['env.radio.range="10": expected a number'],
        ),
        (
            ["consensus", "env.observation=sight"],
            ["comm.name=consensus does not read", "maps does"],
        ),
        (["consensus", "env.radio.range=null"], ["env.radio.range=null: expected a number"]),
        (["consensus", "learner.hidden=true"], ["learner.hidden=true: expected a list"]),
        (["consensus", "zzz=1"], ["'zzz'", "known: setup, world, fire, learner, env", "num_envs"]),
        (["consensus", "method=independent"], ["'method'"]),
        (["consensus", "setup=papr"], ["setup 'papr'", "did you mean paper?", SETUPS]),
        (
            ["consensus", "fire=zzz"],
            ["fire 'zzz'", "known: file, front, huygens, oil_slick, paper, reaction, swarm"],
        ),
        (["consensus", "learner.batch_size=big"], ["learner.batch_size=big", "whole number"]),
        (["consensus", "learner.batch_size=1.5"], ["learner.batch_size=1.5", "whole number"]),
        (["consensus", "env.reward.exit=true"], ["env.reward.exit=true", "number"]),
        (["consensus", "env.grid=30"], ["env.grid=30"]),
        (["consensus", "env=3"], ["env=3"]),
        (["consensus", "seed=null"], ["seed=null", "whole number"]),
        (["consensus", "env.num_uavs=0"], ["env.num_uavs=0", "greater than or equal to 1"]),
        (["consensus", "env.num_uavs=65"], ["env.num_uavs=65", "less than or equal to 64"]),
        (["consensus", "env.grid=[4,30]"], ["env.grid.0=4", "greater than or equal to 8"]),
        (["consensus", "env.altitude=[4,1]"], ["altitude (4.0, 1.0)", "lowest"]),
        (["consensus", "learner.gamma=1.5"], ["learner.gamma=1.5", "less than 1"]),
        (["consensus", "learner.gamma=nan"], ["learner.gamma=nan: expected a finite number"]),
        (["consensus", "env.reward.exit=.inf"], ["env.reward.exit=inf: expected a finite number"]),
        (["consensus", "learner.buffer_size=5"], ["batch_size=8", "buffer_size=5"]),
        (["consensus", "seed=-1"], ["seed=-1", "greater than or equal to 0"]),
        (["consensus", "num_envs=0"], ["num_envs=0"]),
        (["consensus", "learner=[1]"], ["learner '[1]' is not known"]),
        (["consensus", "logger=mlflow"], ["logger=mlflow", "'wandb', 'tensorboard', 'csv'"]),
        (["consensus", "replay=both"], ["replay=both", "'per_agent' or 'shared'"]),
        (["consensus", "env.radio.rnge=3"], ["'env.radio.rnge'", "did you mean env.radio.range?"]),
        (["maps", "comm.range=0"], ["'comm.range'", "did you mean env.radio.range?"]),
        (["maps", "comm.bandwidth=9"], ["'comm.bandwidth'", "did you mean env.radio.bandwidth?"]),
        (["maps", "hold=9"], ["'hold'", "did you mean policy.hold?"]),
        (["maps", "setup.memory=gru"], ["'setup.memory'", "did you mean policy.memory?"]),
        (["consensus", "env.radio.range=nan"], ["env.radio.range=nan: should be greater"]),
        (["consensus", "env.radio.range=-1"], ["env.radio.range=-1", "greater than or equal to 0"]),
        (["consensus", "comm.heading.form=cubic"], ["comm.heading.form=cubic", "'folded_linear'"]),
        (
            ["consensus", "comm.name=telepathy"],
            ["comm.name='telepathy'", "known: consensus, maps, no_comm, positional"],
        ),
        (["consensus", "comm.name=no_comm"], ["comm.", "not a setting of no_comm; known: none"]),
        (["consensus", "learner.hidden=[10000000,8]"], ["learner.hidden.0=10000000", "8192"]),
        (["consensus", "learner.hidden=[]"], ["learner.hidden=[]", "at least 1"]),
        (["consensus", "learner.hidden=[8,8,8,8,8,8,8,8,8]"], ["learner.hidden=", "at most 8"]),
        (["consensus", "num_envs=100000000"], ["num_envs=100000000", "65536"]),
        (["consensus", "device=cuda:99"], ["device=cuda:99 is not available", "known: cpu"]),
        (["consensus", "device=tpu"], ["device=tpu is not available", "known: cpu"]),
        (["consensus", "device=cpu:3"], ["device=cpu:3 is not available", "known: cpu"]),
        (["consensus", "episodes"], ["'episodes'", "key=value"]),
        (["consensus", "a=b=c"], ["'a=b=c'", "key=value"]),
        (["consensus", "=3"], ["key ''"]),
        (["consensus", "+new=1"], ["'+new=1'", "key=value"]),
        (["consensus", "~env"], ["'~env'", "key=value"]),
        (["consensus", "seed=1,2"], ["'seed=1,2'", "one value", "seeds=[1,2]"]),
        (["consensus", "seeds=0,1"], ["'seeds=0,1'", "one value", "seeds=[0,1]"]),
        (["consensus", "env.grid=30,20"], ["one value", "env.grid=[30,20]"]),
        (["consensus", "fire.kind=file"], ["fire.kind", "choose it with fire=NAME"]),
        (["consensus", "comm={range: 3}"], ["give its keys one by one", "comm.KEY=VALUE"]),
        (["consensus", "env.horizon=${nope}"], ["nope", "env.horizon"]),
    ],
    ids=lambda value: " ".join(value) if value and len(value) < 3 else "",
)
def test_bad_input_gives_one_line_and_leaves_no_files(arguments, words, tmp_path, capsys):
    output = tmp_path / "runs"
    method, *overrides = arguments
    # Short, in case the input is accepted.
    refused(["train", method, *TINY, *overrides, f"output={output}"], capsys, *words)
    assert not output.exists()


def test_an_output_folder_that_is_a_file(tmp_path, capsys):
    file = tmp_path / "file"
    file.write_text("mine")
    for output in (file, file / "below"):
        refused(["train", "consensus", *TINY, f"output={output}"], capsys, f"output={output}")
    refused(["train", "consensus", *TINY, "output="], capsys, "output=", "at least 1 character")
    assert file.read_text() == "mine"
    assert list(tmp_path.iterdir()) == [file]


def contents(folder: Path) -> dict[str, bytes]:
    return {str(f): f.read_bytes() for f in sorted(folder.rglob("*")) if f.is_file()}


def test_invalid_run_folder(tmp_path, capsys):
    nowhere, empty = tmp_path / "nowhere", tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(SystemExit):
        main.main(["eval", str(nowhere), "--fires", "65537"])
    assert "'65537' is not a whole number 1 to 65536" in capsys.readouterr().err
    refused(["eval", str(nowhere)], capsys, str(nowhere), "no such run folder")
    refused(["eval", str(empty)], capsys, str(empty), "config.yaml is missing")
    assert not nowhere.exists()
    assert list(empty.iterdir()) == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"learner": {"gama": 0.9}}, ["config.yaml", "learner.gama is not a setting of ddpg"]),
        ({"env": {"num_uavs": 0}}, ["config.yaml", "env.num_uavs=0"]),
        ({"learner": {"hidden": [8, 9]}}, ["made with learner.hidden=[8, 8]", "[8, 9]"]),
        ({"env": {"num_uavs": 3}}, ["made with env.num_uavs=2", "has env.num_uavs=3"]),
        ({"comm": {"name": "positional"}}, ["config.yaml", "comm."]),
    ],
)
def test_run_with_a_configuration_that_does_not_fit(run, change, words, capsys):
    file = run / "config.yaml"
    values = yaml.safe_load(file.read_text())
    for key, inner in change.items():
        values[key] |= inner
    file.write_text(yaml.safe_dump(values))
    before = contents(run)
    refused(["eval", str(run)], capsys, *words)
    assert contents(run) == before


@pytest.mark.parametrize("text", ["", "- 1\n- 2\n", "a: [", "\x00\x01"])
def test_invalid_configuration_file(run, text, capsys):
    (run / "config.yaml").write_text(text)
    refused(["eval", str(run)], capsys, "config.yaml")


def test_a_run_without_a_checkpoint(run, capsys):
    shutil.rmtree(run / "checkpoints")
    refused(["eval", str(run)], capsys, str(run), "holds no checkpoint")


def test_invalid_checkpoint_file(run, capsys):
    checkpoint = RunFolder(run).checkpoint()
    whole = checkpoint.read_bytes()
    for content in (b"", b"not a checkpoint", whole[: len(whole) // 2]):
        checkpoint.write_bytes(content)
        refused(["eval", str(run)], capsys, checkpoint.name, "not a readable checkpoint")
    weights = {"else": torch.zeros(3)}
    save_file(weights, checkpoint)
    refused(["eval", str(run)], capsys, checkpoint.name, "not a readable checkpoint")
    other = run / "nothing.safetensors"
    refused(["eval", str(run), "--checkpoint", str(other)], capsys, other.name)


def test_eval_on_a_missing_device(run, capsys):
    refused(["eval", str(run), "--device", "cuda:99"], capsys, "cuda:99", "known: cpu")


def test_too_little_memory_gives_one_line(capsys, monkeypatch):
    def full(*_):
        raise RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried 99 bytes\nmore")

    monkeypatch.setattr("emberlink.trainers.training.command.Trainer", full)
    refused(["train", "consensus", *TINY], capsys, "not enough memory", "99 bytes")


def test_an_unfinished_line_is_ignored(run):
    lines = RunFolder(run).metrics()
    with (run / "metrics.jsonl").open("a") as out:
        out.write('{"epi')
    assert RunFolder(run).metrics() == lines
    (run / "metrics.jsonl").write_text("{}\nnothing\n")
    with pytest.raises(ValueError, match=r"metrics\.jsonl: not a file of JSON lines"):
        RunFolder(run).metrics()


def test_a_batch_that_is_never_filled_gives_a_warning(tmp_path, capsys):
    assert (
        main.main(["train", "consensus", *TINY, "learner.batch_size=500", f"output={tmp_path}"])
        == 0
    )
    assert "nothing will be learnt" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("method", "setup", "more", "notes"),
    [
        ("shared_memory", "tuned", ["learner=mappo"], ["learner=mappo has no replay buffer"]),
        ("shared_memory", "paper", ["learner=ippo"], ["learner=ippo has", "scale=raw"]),
        ("independent", "paper", ["learner=ippo"], ["env.observation_scale=raw: the first layer"]),
        ("consensus", "released", ["policy.memory=gru"], ["env.observation_scale=raw: the"]),
        ("consensus", "paper", ["learner=ippo", "env.observation_scale=box"], []),
        ("shared_memory", "paper", [], []),
        ("consensus", "tuned", ["learner=mappo"], []),
        ("maps", "paper", ["learner=mappo"], []),
        (
            "consensus",
            "tuned",
            ["policy.units=8"],
            ["policy.units=8 has no effect with policy.memory=none"],
        ),
        ("consensus", "tuned", ["learner.burn_in=2"], ["learner.burn_in=2 has no effect with"]),
        (
            "consensus",
            "tuned",
            ["policy.memory=gru", "policy.decisions=4"],
            ["policy.decisions=4 has"],
        ),
        ("consensus", "tuned", ["policy.memory=stack", "policy.units=8"], ["policy.units=8 has"]),
        ("consensus", "tuned", ["policy.memory=gru", "policy.units=8"], []),
        ("consensus", "tuned", ["policy.memory=stack", "policy.decisions=4"], []),
        (
            "consensus",
            "tuned",
            ["policy.memory=stack", "policy.decisions=5", "learner.burn_in=3"],
            [
                "learner.burn_in=3: in the middle of an episode, sequences begin with zeros in the "
                "memory; learner.burn_in=4 fills it"
            ],
        ),
        (
            "consensus",
            "tuned",
            ["policy.memory=stack", "policy.decisions=5", "learner.burn_in=4"],
            [],
        ),
        ("consensus", "tuned", ["policy.memory=gru", "learner.burn_in=0"], []),
        ("consensus", "tuned", ["learner=ippo", "policy.memory=stack"], []),
    ],
)
def test_notes_of_a_training(method, setup, more, notes, tmp_path, capsys):
    small = [text for text in TINY if not text.startswith(("setup=", "learner."))]
    small += [f"setup={setup}", "learner.hidden=[8]", f"output={tmp_path}"]
    replays = not any("ppo" in text for text in more)
    small += ["learner.batch_size=4"] if replays else ["learner.minibatches=1"]
    remembers = any("policy.memory=" in text for text in more)
    small += ["learner.sequence=4"] if replays and remembers else []
    assert main.main(["train", method, *small, *more]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert said.count("note: ") == len(notes), said
    assert all(note in said for note in notes)


@pytest.mark.parametrize(
    "arguments",
    [
        ["eval", "x" * 300],
        ["render", "x" * 300],
        ["compare", "x" * 300],
        ["train", "resume=" + "x" * 300],
        ["sweep", "independent", "output=" + "x" * 300, "--dry-run"],
        ["train", "maps", "learner=ippo", "learner.warm_start=" + "x" * 300, "output=runs"],
    ],
)
def test_a_name_that_is_too_long_gives_one_line(arguments, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main.main(arguments) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert error.startswith(f"emberlink {arguments[0]}: ")
    assert "xxx" in error
    assert len(error) < 700
    assert not list(tmp_path.iterdir())
