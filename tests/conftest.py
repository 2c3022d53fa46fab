"""What all tests share."""

import pytest


@pytest.fixture(autouse=True, scope="session")
def _own_cache(tmp_path_factory):
    """Banks of fires are cached in a folder of the tests' own, also by what they start."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("EMBERLINK_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield
