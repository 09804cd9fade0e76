"""What tests of local pages share: a headless browser, and a page that another process serves."""

import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
FLAGS = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
LIMIT = 30_000  # ms to wait for anything in the page


@pytest.fixture(scope="module")
def browser():
    """A headless Chromium, one a file; the test is skipped where there is none."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    path = next(filter(None, map(shutil.which, NAMES)), None)
    if path is None:
        pytest.skip("there is no chromium on this computer")
    with playwright.sync_playwright() as driver:
        chromium = driver.chromium.launch(executable_path=path, args=FLAGS)
        yield chromium
        chromium.close()


@dataclass
class Tab:
    """A page of a browser of its own (no cookie yet), and what it asked for and complained of."""

    page: object
    asked: list[str] = field(default_factory=list)
    complaints: list[str] = field(default_factory=list)

    @property
    def elsewhere(self) -> list[str]:
        """Requests and sockets that did not go to 127.0.0.1."""
        return [
            url for url in self.asked if not re.match(r"(http|ws)://127\.0\.0\.1:|data:|blob:|about:", url)
        ]


@contextmanager
def tab(browser, width: int = 1366, height: int = 768) -> Iterator[Tab]:
    """A fresh tab, as wide as a laptop's."""
    context = browser.new_context(viewport={"width": width, "height": height})
    context.set_default_timeout(LIMIT)
    page = context.new_page()
    opened = Tab(page)
    page.on("request", lambda request: opened.asked.append(request.url))
    page.on("websocket", lambda ws: opened.asked.append(ws.url))
    page.on("pageerror", lambda error: opened.complaints.append(str(error)))
    yield opened
    context.close()


@dataclass
class Served:
    """A process that serves a page."""

    process: subprocess.Popen
    address: str

    @property
    def url(self) -> str:
        """The address without its token."""
        return self.address.partition("?")[0]


@contextmanager
def served(*arguments: str, cwd: Path | None = None) -> Iterator[Served]:
    """Run ``python ARGUMENTS`` until it has printed the address of its page; ended afterwards."""
    process = subprocess.Popen(
        [sys.executable, *arguments], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=cwd
    )
    try:
        yield Served(process, _address(process))
    finally:
        process.kill()
        process.communicate()


def _address(process: subprocess.Popen) -> str:
    lines = []
    for line in process.stdout:
        lines.append(line)
        if found := re.search(r"http://127\.0\.0\.1:\d+/\?token=\S+", line):
            return found[0]
    raise AssertionError("no page was served:\n" + "".join(lines))
