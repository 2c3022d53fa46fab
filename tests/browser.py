"""Finds the browser of the tests and opens pages in it."""

import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome")
QUIET = ("--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking")
MISSING = (
    "no browser: the tests of replays need Chromium (Debian: apt-get install chromium), or its "
    "path in EMBERLINK_BROWSER"
)


@contextmanager
def chromium() -> Iterator:
    """Yields a running browser; without one the test fails with one line."""
    from playwright.sync_api import sync_playwright

    found = os.environ.get("EMBERLINK_BROWSER") or next(
        filter(None, map(shutil.which, NAMES)), None
    )
    if found is None:
        pytest.fail(MISSING, pytrace=False)
    with sync_playwright() as driver:
        more = ("--disable-component-update", "--disable-sync")
        browser = driver.chromium.launch(executable_path=found, args=[*QUIET, *more])
        yield browser
        browser.close()


class Tab:
    """An open page, and what went wrong on it.

    Args:
        browser: see `chromium`.
        address: of the page.
        options: of the browser's context, such as the width.
    """

    def __init__(self, browser, address: str, **options):
        options.setdefault("viewport", {"width": 1300, "height": 900})
        self._context = browser.new_context(**options)
        self.page = self._context.new_page()
        self.problems: list[str] = []
        self.requests: list[str] = []
        self.page.on("console", lambda line: self.problems.append(line.text))
        self.page.on("pageerror", lambda error: self.problems.append(str(error)))
        self.page.on("dialog", lambda dialog: self.problems.append(dialog.message))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.goto(address)

    def wait_for(self, expression: str, seconds: float = 30.0) -> None:
        """Waits until an expression is true; the page's policy forbids wait_for_function."""
        end = time.monotonic() + seconds
        while not self.page.evaluate(expression):
            assert time.monotonic() < end, f"still false: {expression}"
            self.page.wait_for_timeout(20)

    def close(self) -> None:
        self._context.close()
