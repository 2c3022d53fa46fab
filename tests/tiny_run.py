"""A training that takes about a second."""

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
PROGRAM = (
    "import signal, sys\n"
    # A program started in the background may have inherited that Ctrl-C is ignored.
    "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    "from emberlink.trainers.cli.main import main\n"
    "sys.exit(main())"
)


def train_tiny(output: Path) -> Path:
    """The run folder that `emberlink train` leaves in an empty folder."""
    assert main.main(["train", "consensus", *TINY, f"output={output}"]) == 0
    (folder,) = output.iterdir()
    return folder
