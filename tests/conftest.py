"""Fixtures for all tests."""

import io
import random
import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest
from matplotlib.figure import Figure
from PIL import Image
from tiny_run import train_tiny

from emberlink.envs import wildfire


@pytest.fixture(autouse=True, scope="session")
def _environment(tmp_path_factory):
    """Gives the tests and their subprocesses a temporary cache and no terminal."""
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("COLUMNS", raising=False)
        patch.setenv("EMBERLINK_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(autouse=True)
def _blank_figures(request, monkeypatch) -> None:
    """Saves a blank picture for each figure, except in tests marked `drawn`, which look at it.

    Drawing takes half of the time of a short training.
    """
    if request.node.get_closest_marker("drawn"):
        return
    blank = io.BytesIO()
    Image.new("RGB", (8, 8)).save(blank, "png")
    monkeypatch.setattr(Figure, "savefig", lambda _, path, **__: path.write_bytes(blank.getvalue()))


@pytest.fixture(autouse=True)
def _repeatable_seeds(monkeypatch) -> None:
    """Draws the seeds of environments without a seed from a generator, the same in every run."""
    draw = random.Random(0)
    monkeypatch.setattr(wildfire, "secrets", SimpleNamespace(randbelow=draw.randrange))


@pytest.fixture(scope="session")
def finished(tmp_path_factory) -> Path:
    """Trains a short run and returns its folder."""
    return train_tiny(tmp_path_factory.mktemp("runs"))


@pytest.fixture
def run(finished, tmp_path) -> Path:
    """Returns a copy of the finished run that a test may damage."""
    return Path(shutil.copytree(finished, tmp_path / "run"))
