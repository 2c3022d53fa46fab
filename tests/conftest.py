"""Fixtures for all tests.

The process that starts the others of pytest-xdist reads this file first, so slow imports are in the
fixtures.
"""

import importlib
import io
import os
import random
import shutil
import warnings
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import pytest
from tiny_run import train_tiny


@pytest.fixture(autouse=True, scope="session")
def _environment(tmp_path_factory):
    """Gives the tests and their subprocesses a temporary cache and no terminal."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("COLUMNS", "EMBERLINK_CONFIGS", "FORCE_COLOR", "NO_COLOR"):
            patch.delenv(name, raising=False)
        patch.setenv("EMBERLINK_CACHE", str(_cache(tmp_path_factory)))
        yield


def _cache(tmp_path_factory) -> Path:
    """Returns an empty folder, the same for all processes of pytest-xdist."""
    if "PYTEST_XDIST_WORKER" not in os.environ:
        return tmp_path_factory.mktemp("cache")
    folder = tmp_path_factory.getbasetemp().parent / "cache"
    folder.mkdir(exist_ok=True)
    return folder


@pytest.fixture(autouse=True, scope="session")
def _torchrl_is_imported() -> None:
    """Imports TorchRL's collectors: they warn at the import, which would be in some test."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        importlib.import_module("torchrl.collectors")


@pytest.fixture(autouse=True)
def _blank_figures(request, monkeypatch) -> None:
    """Saves blank pictures, except in tests marked `drawn`: drawing takes half of a training."""
    if request.node.get_closest_marker("drawn"):
        return
    from matplotlib.figure import Figure

    from emberlink.trainers.evaluation import evaluate_run

    blank = _blank()
    for name in ("timelapse", "training_curves"):
        monkeypatch.setattr(evaluate_run, name, lambda path, *_: path.write_bytes(blank))

    def save(_: Figure, file: io.BytesIO | Path, **__) -> None:
        file.write(blank) if isinstance(file, io.BytesIO) else file.write_bytes(blank)

    monkeypatch.setattr(Figure, "savefig", save)
    monkeypatch.setattr(evaluate_run, "write_gif", lambda path, *_: path.write_bytes(blank))


@cache
def _blank() -> bytes:
    from PIL import Image

    file = io.BytesIO()
    Image.new("RGB", (8, 8)).save(file, "png")
    return file.getvalue()


@pytest.fixture(autouse=True)
def _repeatable_seeds(monkeypatch) -> None:
    """Draws the seeds of environments without a seed from a generator, the same in every run."""
    from emberlink.envs import wildfire

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
