"""What all tests share."""

import shutil
from pathlib import Path

import pytest
from tiny_run import train_tiny


@pytest.fixture(autouse=True, scope="session")
def _own_cache(tmp_path_factory):
    """Banks of fires are cached in a folder of the tests' own, also by what they start."""
    with pytest.MonkeyPatch.context() as patch:
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
