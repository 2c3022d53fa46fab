"""Tests that the package fits into other programs: threads and paths."""

import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from torchrl.envs.utils import exploration_type

from emberlink import trainers
from emberlink.trainers.cli.main import main
from emberlink.trainers.runs.run_folder import RunFolder

SHORT = {"horizon": 15, "num_uavs": 2, "num_envs": 2, "batch_size": 8, "evaluation.episodes": 2}
SHORT |= {"episodes": 2, "evaluation.interval": 1, "evaluation.interval_episodes": 2}


def test_two_threads_train_as_one_alone(tmp_path):
    """Validations beside a training leave its noise as it is, and nothing of the process set."""

    def train(seed, place):
        more = {"output": str(tmp_path / place), "evaluation.scripted": [], "seed": seed}
        run = trainers.train("independent", setup="tuned", **SHORT, **more)
        return RunFolder(run.path).metrics(), run.results

    before = {**os.environ}, exploration_type()
    alone = [train(seed, "alone") for seed in (0, 1)]
    with ThreadPoolExecutor(2) as pool:
        assert list(pool.map(train, (0, 1), ("both", "both"))) == alone
    assert before == ({**os.environ}, exploration_type())


def test_home_folders_are_expanded(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "setup").mkdir()
    (tmp_path / "setup" / "mine.yaml").write_text("# @package _global_\ndefaults: [tuned]\n")
    monkeypatch.setenv("EMBERLINK_CONFIGS", "~")
    np.save("drawn.npy", np.add.outer(np.arange(9.0), np.arange(9.0))[None])
    grid = ["env.grid=[9,9]", "fire.unburned=none"]
    more = [*grid, "setup=mine"]
    assert main(["fire", "import", "~/drawn.npy", "--output=~/fires.npy", *more]) == 0
    assert main(["fire", "preview", "~/fires.npy", "--output=~/fire.png", *grid]) == 0
    policy = trainers.load("pretrained:consensus")
    (tmp_path / "here").write_bytes(policy.checkpoint.read_bytes())
    assert trainers.load("pretrained:consensus", checkpoint="~/here").checkpoint.parent == tmp_path
    assert not (tmp_path / "~").exists()
    assert {"fires.npy", "fire.png"} < {file.name for file in tmp_path.iterdir()}
