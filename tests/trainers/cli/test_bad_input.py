"""Tests that invalid input gives a one-line error, exit status 2, and no files."""

import subprocess
import sys

import pytest
from refusal import refused
from tiny_run import TINY

IMITATE = "train maps setup=tuned learner=imitation fire.num_train_fires=2"
METHODS = "known: consensus, independent, maps, positional, shared_memory"
NOWHERE = "~nobody_here/x"
HOME = ["~nobody_here", "home folder"]
TRAININGS = [
    ("consensu", ["'consensu'", "did you mean consensus?", METHODS]),
    ("consensus maps", ["'maps' is not of the form key=value"]),
    ("independent env.failures=2.5", ["env.failures=2.5", "the team has 2 UAVs"]),
    ("independent evaluation.scripted=[orcale]", ["orcale", "did you mean oracle?"]),
    ("consensus learner.buffer_size=5", ["batch_size=8", "buffer_size=5"]),
    ("consensus comm.name=telepathy", ["telepathy", "known: consensus, maps, no_comm"]),
    ("consensus seed=1,2", ["'seed=1,2'", "one value", "emberlink sweep"]),
]
COMMANDS = [
    ("train", ["required: METHOD ("]),
    ("train independent --episodes 5", ["--episodes", "key=value"]),
    ("eval pretrained:maps evaluation.message_fault=zero", ["no learned messages"]),
    ("sweep consensus seed=range(3,3)", ["no run: a key has no value"]),
    ("sweep executor=slurm", ["executor='slurm' is not known; known: local"]),
    ("world check front evaluation.scripted=[oracle]", ["lacks random_way"]),
    ("train maps env.observation=vector", ["comm.name=maps exchanges the UAVs' maps"]),
    (f"{IMITATE} learner.teacher=oracle", ["as map_greedy does"]),
    (f"train independent output={NOWHERE}", HOME),
    (f"compare {NOWHERE}", HOME),
]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        # Short, in case the input is accepted.
        *((["train", text.split()[0], *TINY, *text.split()[1:]], said) for text, said in TRAININGS),
        *((text.split(), said) for text, said in COMMANDS),
    ],
    ids=[text for text, _ in TRAININGS + COMMANDS],
)
def test_a_mistake_is_one_line_and_leaves_no_files(arguments, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    refused(arguments, capsys, *words)
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("wrong", "seconds"),
    [
        *(("train nosuchmethod", 1), ("sweep nosuchmethod", 1), ("eval nowhere", 1)),
        ("train independent x=1", 2),
    ],
)
def test_a_wrong_name_or_key_is_answered_without_torch(wrong, seconds):
    program = (
        "import sys, time; from emberlink.trainers.cli.main import main\n"
        f"try: status = main({wrong.split()})\nexcept SystemExit as end: status = end.code\n"
        "assert 'torch' not in sys.modules; print(status, time.process_time())"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    status, spent = done.stdout.split()
    assert status == "2", done.stderr
    assert float(spent) < 2 * seconds  # test machines are slower than users' machines


def test_invalid_run_folders(run, tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    refused(["eval", tmp_path / "nowhere"], capsys, "nowhere")
    refused(["eval", tmp_path / "empty"], capsys, "empty")
    refused(["eval", run, "--device", "cuda:99"], capsys, "cuda:99", "known: cpu")
    refused(["eval", run, "--checkpoint", run / "none"], capsys, "none")
