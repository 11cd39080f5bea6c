"""A Chromium without a window, for what looks at the dashboard as a person would."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

NAMES = ("chromium", "chromium-browser", "google-chrome")
FLAGS = [
    "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync",
]  # fmt: skip
#: Seconds that a page may take to come.
PATIENCE_S = 120.0
#: Notes when the main part of the page was last there, by the clock that begins with the page.
_WATCH = """new MutationObserver(() => {
  const main = document.getElementById("main");
  window.settledAt = main?.getAttribute("aria-busy") === "false" ? performance.now() : undefined;
}).observe(document, {subtree: true, attributes: true, attributeFilter: ["aria-busy"]});"""


def installed() -> str | None:
    """Path of a Chromium; None where there is none."""
    return next(filter(None, map(shutil.which, NAMES)), None)


@contextmanager
def chromium(path: str) -> Iterator[Browser]:
    """A browser; it is gone when this ends."""
    from playwright.sync_api import sync_playwright  # of the extra `dev`

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=FLAGS)
        try:
            yield browser
        finally:
            browser.close()


def watched(page: Page) -> Page:
    """A page that notes when it has settled: `settled` tells."""
    page.add_init_script(_WATCH)
    return page


def settled(page: Page) -> float:
    """Milliseconds from the beginning of a page until its main part was there."""
    return float(until(page, "window.settledAt"))


def until(page: Page, expression: str) -> Any:
    """The first value of an expression that is neither null nor false.

    Asked for again and again from here: what Playwright has for it evaluates in the page, which
    the dashboard's policy forbids.
    """
    return _until(lambda: page.evaluate(expression), expression)


def _until(ask: Callable[[], Any], what: str) -> Any:
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        found = ask()
        if found is not None and found is not False:
            return found
        time.sleep(0.02)
    raise TimeoutError(f"{what} did not come true within {PATIENCE_S:g} s")
