"""What all tests share."""

import shutil
from pathlib import Path

import pytest
from tiny_run import train_tiny

from emberlink.trainers.evaluation import plots, report


@pytest.fixture(autouse=True, scope="session")
def _environment(tmp_path_factory):
    """Gives the tests, and the programs that they start, a cache of their own and no terminal."""
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("COLUMNS", raising=False)
        patch.setenv("EMBERLINK_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture
def quick_figures(monkeypatch) -> None:
    """Leaves the pictures of an evaluation empty, which draws them in half of its time."""

    def empty(path: Path, *_) -> None:
        path.write_bytes(b"")

    for name in ("coverage_bars", "training_curves", "timelapse"):
        monkeypatch.setattr(plots, name, empty)
    monkeypatch.setattr(report, "write_gif", empty)


@pytest.fixture(scope="session")
def finished(tmp_path_factory) -> Path:
    """A run folder that `emberlink train` left."""
    return train_tiny(tmp_path_factory.mktemp("runs"))


@pytest.fixture
def run(finished, tmp_path) -> Path:
    """A copy of it, to be damaged."""
    return Path(shutil.copytree(finished, tmp_path / "run"))
