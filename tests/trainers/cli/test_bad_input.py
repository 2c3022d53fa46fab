"""Tests that invalid input gives a one-line error, exit status 2, and no files."""

import subprocess
import sys

import pytest
from tiny_run import TINY

from emberlink.trainers.cli import main


def refused(arguments: list[str], capsys, *words: str) -> None:
    """Runs a command that ends with status 2, and checks the words of its one line."""
    capsys.readouterr()
    try:
        status = main.main(arguments)
    except SystemExit as ended:
        status = ended.code
    out, err = capsys.readouterr()
    assert (status, out, err.count("\n")) == (2, "", 1), err
    assert len(err) < 400
    for word in words:
        assert word in err, err


METHODS = "known: consensus, independent, maps, positional, shared_memory"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["consensu"], ["'consensu'", "did you mean consensus?", METHODS]),
        ([""], ["''", METHODS]),
        (["consensus", "maps"], ["'maps'", "emberlink sweep consensus maps"]),
        (["consensus", "learner.gama=0.9"], ["'learner.gama'", "did you mean learner.gamma?"]),
        (["consensus", "lr=0.1"], ["'lr'", "learner.actor_lr or learner.critic_lr"]),
        (["independent", "comm.jitter=5"], ["'comm.jitter'"]),
        (["independent", "learner.clip=0.1"], ["'learner.clip'"]),
        (["independent", "learner=ippo", "learner.tau=0.1"], ["'learner.", "known: learner.name"]),
        (["independent", "world=fornt"], ["world 'fornt'", "did you mean front?"]),
        (["independent", "env.failures=2.5"], ["env.failures=2.5", "the team has 2 UAVs"]),
        (["independent", "evaluation.headline=age"], ["evaluation.headline=age", "known: "]),
        (["independent", "evaluation.scripted=[orcale]"], ["orcale", "did you mean oracle?"]),
        (["consensus", "zzz=1"], ["'zzz'", "known: env", "num_envs"]),
        (["consensus", "learner.batch_size=1.5"], ["learner.batch_size=1.5", "integer"]),
        (["consensus", "env=3"], ["env=3"]),
        (["consensus", "env.grid=[4,30]"], ["env.grid.0=4", "greater than or equal to 8"]),
        (["consensus", "learner.buffer_size=5"], ["batch_size=8", "buffer_size=5"]),
        (["consensus", "logger=mlflow"], ["logger=", "'wandb', 'tensorboard', 'csv'"]),
        (["maps", "comm.range=0"], ["'comm.range'", "did you mean env.radio.range?"]),
        (["consensus", "comm.name=telepathy"], ["telepathy", "known: consensus, maps, no_comm"]),
        (["consensus", "device=cuda:99"], ["device=cuda:99 is not available", "known: cpu"]),
        (["consensus", "~env"], ["'~env'", "key=value"]),
        (["consensus", "+new=1"], ["'+new'"]),
        (["consensus", "seed=1,2"], ["'seed=1,2'", "one value", "emberlink sweep"]),
        (["consensus", "env.grid=30,20"], ["one value", "env.grid=[30,20]"]),
        (["consensus", "fire.kind=file"], ["fire.kind", "choose it with fire=NAME"]),
        (["consensus", "env.horizon=${nope}"], ["nope", "env.horizon"]),
        (["consensus", "output="], ["output=", "at least 1 character"]),
    ],
    ids=lambda value: " ".join(value) if len(value) < 4 else "",
)
def test_bad_input_gives_one_line_and_leaves_no_files(arguments, words, tmp_path, capsys):
    method, *overrides = arguments
    output = tmp_path / "runs"
    # Short, in case the input is accepted.
    refused(["train", method, *TINY, f"output={output}", *overrides], capsys, *words)
    assert not output.exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["trian"], ["'trian'", "did you mean train?"]),
        (["train"], ["required: METHOD ("]),
        (["train", "independent", "--episodes", "5"], ["--episodes", "key=value"]),
        (["eval", "RUN", "--chekpoint", "x"], ["did you mean --checkpoint?"]),
        (["eval", "RUN", "--fires", "65537"], ["'65537' is not a whole number from 1 to 65536"]),
        (["list", "method"], ["known: methods, setups"]),
    ],
)
def test_usage_errors_are_one_line(arguments, words, capsys):
    refused(arguments, capsys, *words)


@pytest.mark.parametrize(("wrong", "seconds"), [("nosuchmethod", 1), ("independent x=1", 2)])
def test_a_wrong_name_is_answered_without_torch(wrong, seconds):
    program = (
        "import sys, time; from emberlink.trainers.cli.main import main\n"
        f"status = main({['train', *wrong.split()]})\n"
        "assert 'torch' not in sys.modules; print(status, time.process_time())"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    status, spent = done.stdout.split()
    assert status == "2", done.stderr
    assert float(spent) < 2 * seconds  # machines that test are slower than those of users


def test_a_proposed_list_is_accepted(tmp_path, capsys):
    refused(["train", "consensus", "env.grid=30,20"], capsys)
    assert main.main(["train", "consensus", *TINY, "env.grid=[30,20]", f"output={tmp_path}"]) == 0


def test_an_output_folder_that_is_a_file(tmp_path, capsys):
    file = tmp_path / "file"
    file.write_text("mine")
    for output in (file, file / "below"):
        refused(["train", "consensus", *TINY, f"output={output}"], capsys, f"output={output}")
    assert file.read_text() == "mine"


def test_invalid_run_folders(run, tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    refused(["eval", str(tmp_path / "nowhere")], capsys, "nowhere")
    refused(["eval", str(tmp_path / "empty")], capsys, "empty")
    refused(["eval", str(run), "--device", "cuda:99"], capsys, "cuda:99", "known: cpu")
    refused(["eval", str(run), "--checkpoint", str(run / "none")], capsys, "none")


def test_a_run_without_a_checkpoint(run, capsys):
    for path in run.rglob("*.safetensors"):
        path.unlink()
    refused(["eval", str(run)], capsys, str(run))


def test_too_little_memory_gives_one_line(capsys, monkeypatch):
    def full(*_):
        raise RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried 99 bytes\nmore")

    monkeypatch.setattr("emberlink.trainers.training.command.Trainer", full)
    refused(["train", "consensus", *TINY], capsys, "not enough memory", "99 bytes")


@pytest.mark.parametrize(
    "arguments",
    [
        ["eval", "x" * 300],
        ["compare", "x" * 300],
        ["train", "resume=" + "x" * 300],
        ["sweep", "independent", "output=" + "x" * 300, "--dry-run"],
    ],
)
def test_a_name_that_is_too_long_gives_one_line(arguments, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main.main(arguments) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not list(tmp_path.iterdir())
