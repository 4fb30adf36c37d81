"""A headless Chromium for tests of pages, without a network.

Without a browser or Playwright, tests are skipped with the reason. Continuous
integration sets ``NEWTON_QD_TEST_BROWSER=required``, and they fail there.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
FLAGS = (
    "--no-sandbox",
    "--disable-gpu",
    "--enable-unsafe-swiftshader",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
SIZE = {"width": 390, "height": 400}  # drawing takes most of the time


def chromium() -> str | None:
    """Path of the browser, from ``NEWTON_QD_CHROMIUM`` or the system."""
    given = os.environ.get("NEWTON_QD_CHROMIUM")
    return given or next(filter(None, map(shutil.which, NAMES)), None)


def missing() -> str | None:
    """What is missing to test pages."""
    if importlib.util.find_spec("playwright") is None:
        return "Playwright is not installed: pip install 'newton_qd[dev]'"
    if chromium() is None:
        return f"no browser in PATH ({', '.join(NAMES)}), see NEWTON_QD_CHROMIUM"
    return None


def until(page: Any, condition: str) -> None:
    """Waits until an expression of a page is true.

    Playwright's own function evaluates text in the page, which its policy forbids.
    """
    for _ in range(1600):  # 40 s: all cores may be busy
        if page.evaluate(condition):
            return
        page.wait_for_timeout(25)
    raise AssertionError(f"never true: {condition}")


class Pages:
    """Opens pages; collects what they complain about and what they ask for.

    Attributes:
        errors: Errors of scripts, and of the console.
        requests: Addresses that pages asked for.
    """

    def __init__(self, context: Any) -> None:
        self.context = context
        self.errors: list[str] = []
        self.requests: list[str] = []

    def open(self, path: Path, **size: int) -> Any:
        """Opens a file and waits until its player has drawn a frame."""
        page = self.context.new_page()
        page.set_viewport_size(size or SIZE)
        page.on("pageerror", lambda error: self.errors.append(str(error)))
        page.on("console", self._heard)
        page.on("request", lambda request: self.requests.append(request.url))
        page.goto(path.absolute().as_uri())
        until(page, "NQD.player && NQD.player.cost > 0")
        return page

    def _heard(self, message: Any) -> None:
        if message.type == "error":
            self.errors.append(message.text)


@pytest.fixture(scope="module")
def chrome() -> Iterator[Any]:
    """A browser for all tests of a module."""
    lacking = missing()
    if lacking is not None:
        if os.environ.get("NEWTON_QD_TEST_BROWSER") == "required":
            pytest.fail(lacking)
        pytest.skip(lacking)
    from playwright.sync_api import sync_playwright

    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=chromium(), args=[*FLAGS])
        with contextlib.closing(browser):
            yield browser


@pytest.fixture
def pages(chrome: Any) -> Iterator[Pages]:
    """Pages of one test; afterwards, none may have had an error or used a network."""
    context = chrome.new_context(offline=True)
    found = Pages(context)
    yield found
    context.close()
    assert not found.errors
    assert all(url.startswith(("file:", "data:", "blob:")) for url in found.requests)
