"""Trains for about a second."""

from pathlib import Path

from emberlink.trainers.cli import main

TINY = [
    *("episodes=2", "env.horizon=15", "env.num_uavs=2", "num_envs=2"),
    *(
        "learner.hidden=[8,8]",
        "learner.batch_size=8",
        "evaluation.episodes=2",
        "evaluation.interval=0",
    ),
]


def train_tiny(output: Path) -> Path:
    """Runs `emberlink train` in an empty folder and returns the run folder."""
    assert main.main(["train", "consensus", *TINY, f"output={output}"]) == 0
    (folder,) = output.iterdir()
    return folder
