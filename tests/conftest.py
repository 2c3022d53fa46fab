"""What all tests share."""

import shutil
from pathlib import Path

import pytest
from tiny_run import train_tiny


@pytest.fixture(autouse=True, scope="session")
def _environment(tmp_path_factory):
    """Gives the tests, and the programs that they start, a cache of their own and no terminal."""
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("COLUMNS", raising=False)
        patch.setenv("EMBERLINK_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="session")
def finished(tmp_path_factory) -> Path:
    """A run folder that `emberlink train` left."""
    return train_tiny(tmp_path_factory.mktemp("runs"))


@pytest.fixture
def run(finished, tmp_path) -> Path:
    """A copy of it, to be damaged."""
    return Path(shutil.copytree(finished, tmp_path / "run"))
