"""Prints the ratios of a run at its end."""

import pytest

_RATIOS = pytest.StashKey[list[str]]()


@pytest.fixture
def tell(request):
    """Adds a line to the summary at the end."""
    lines = request.config.stash.setdefault(_RATIOS, [])
    return lines.append


def pytest_terminal_summary(terminalreporter, config):
    lines = config.stash.get(_RATIOS, [])
    if lines:
        terminalreporter.section("ratios taken in this run")
        for line in lines:
            terminalreporter.write_line(line)
