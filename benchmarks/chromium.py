"""Headless Chromium for measurements and screenshots of the dashboard."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from benchmarks.waiting import until as until_true

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

NAMES = ("chromium", "chromium-browser", "google-chrome")
FLAGS = [
    "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync",
]  # fmt: skip
#: Script that records the time since navigation at which the main part of the page became ready.
_WATCH = """new MutationObserver(() => {
  const main = document.getElementById("main");
  window.settledAt = main?.getAttribute("aria-busy") === "false" ? performance.now() : undefined;
}).observe(document, {subtree: true, attributes: true, attributeFilter: ["aria-busy"]});"""


def installed() -> str | None:
    """Return the path of a Chromium, or None if none is installed."""
    return next(filter(None, map(shutil.which, NAMES)), None)


@contextmanager
def chromium(path: str) -> Iterator[Browser]:
    """Run a browser until the context ends."""
    from playwright.sync_api import sync_playwright  # in the extra `dev`

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=FLAGS)
        try:
            yield browser
        finally:
            browser.close()


def watch_page(page: Page) -> Page:
    """Make a page record when its main part is ready, for `settled`; return the page."""
    page.add_init_script(_WATCH)
    return page


def settled(page: Page) -> float:
    """Wait until the main part of a page is ready; return the time since navigation, ms."""
    return float(until(page, "window.settledAt"))


def until(page: Page, expression: str) -> Any:
    """Wait until a JavaScript expression is neither null nor false, and return its value.

    The wait of Playwright uses `eval`, which the policy of the dashboard forbids.
    """

    def values() -> list[Any]:
        value = page.evaluate(expression)
        return [] if value is None or value is False else [value]

    return until_true(values)[0]
