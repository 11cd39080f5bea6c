"""Tests of the built site: warnings, links, external content, and search in a browser."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import threading
from functools import partial
from html.parser import HTMLParser
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

from tools.site.reference import generated_pages

pytestmark = pytest.mark.thorough  # builds the site, which takes longest of all

ROOT = Path(__file__).resolve().parents[2]
#: What axe finds in the theme's own markup (two landmarks of one name, tables that scroll and that
#: Chromium focuses without being told), and in tables whose columns need no titles.
KNOWN = {"landmark-unique", "scrollable-region-focusable", "empty-table-header"}


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The site, built as `make docs` builds it: a warning is an error."""
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return folder


class PageReader(HTMLParser):
    """What a page links to, what it loads, and the anchors that it has."""

    def __init__(self, text):
        super().__init__()
        self.links: list[str] = []
        self.loads: list[str] = []
        self.anchors: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        given = {name: value or "" for name, value in attrs}
        self.anchors |= {given[name] for name in ("id", "name") if name in given}
        if "src" in given:
            self.loads.append(given["src"])
        if "href" in given and tag == "link" and given.get("rel") != "canonical":
            self.loads.append(given["href"])
        elif "href" in given and tag == "a":
            self.links.append(given["href"])


@pytest.fixture(scope="module")
def read(site):
    return {path: PageReader(path.read_text()) for path in site.rglob("*.html")}


def test_every_page_is_there(site, read):
    pages = {path.relative_to(site).as_posix() for path in read}
    docs = ROOT / "docs"
    written = {
        path.relative_to(docs).with_suffix(".html").as_posix() for path in docs.rglob("*.md")
    }
    written -= {"README.html"}
    generated = {one.path.replace(".md", ".html") for one in generated_pages()}
    outside = {
        "CHANGELOG.html", "CONTRIBUTING.html", "examples/index.html",
        "examples/robot_loop.py.html", "ros2/sceneprint_ros/index.html",
    }  # fmt: skip
    assert written | generated | outside | {"index.html", "404.html"} <= pages


def test_no_link_and_no_anchor_is_dead(site, read):
    dead = []
    checked = 0
    for path, page in read.items():
        if path.name == "404.html":  # it may be shown at any address
            continue
        for link in page.links:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            if target.is_dir():
                target /= "index.html"
            anchor = unquote(parts.fragment)
            known = target in read and (not anchor or anchor in read[target].anchors)
            checked += 1
            if not known and (anchor or not target.is_file()):
                dead.append(f"{path.relative_to(site)}: {link}")
    assert dead == []
    assert checked > 5_000


def test_nothing_is_loaded_from_another_host(site, read):
    loaded = {url for page in read.values() for url in page.loads}
    assert {url for url in loaded if urlsplit(url).netloc} == set()
    styles = "".join(path.read_text() for path in site.rglob("*.css"))
    found = re.findall(r"url\(([^)]*)\)|@import\s+([^;]+)", styles)
    assert {one for pair in found for one in pair if "//" in one and "data:" not in one} == set()


class _QuietHandler(SimpleHTTPRequestHandler):
    def log_message(self, *_):
        """Say nothing."""


@pytest.fixture(scope="module")
def address(site):
    """Where the site is served."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(_QuietHandler, directory=str(site)))
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_address[1]}"
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.fixture(scope="module")
def browser():
    from playwright.sync_api import sync_playwright

    names = ("chromium", "chromium-browser", "google-chrome")
    chromium = next((path for name in names if (path := shutil.which(name))), None)
    if chromium is None:
        pytest.skip("needs Chromium: apt install chromium")
    with sync_playwright() as playwright:
        one = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        yield one
        one.close()


@pytest.mark.parametrize(("scheme", "width"), [("light", 1280), ("dark", 1280), ("light", 390)])
def test_pages_are_read_and_searched_in_a_browser(address, browser, scheme, width):
    from axe_playwright_python.sync_playwright import Axe

    asked = []
    page = browser.new_page(
        color_scheme=scheme, viewport={"width": width, "height": 900}
    )  # fmt: skip
    page.on("request", lambda request: asked.append(request.url))
    for path in ("index.html", "architecture.html", "reference/http/jobs.html"):
        page.goto(f"{address}/{path}")
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), path
        found = Axe().run(page).response["violations"]
        ours = [one for one in found if one["id"] not in KNOWN]
        assert [(one["id"], one["nodes"][0]["html"]) for one in ours] == [], path
    page.locator("label[for=__search]:visible, input.md-search__input:visible").first.click()
    page.keyboard.type("ambiguous")
    results = page.locator(".md-search-result__item")
    results.first.wait_for()
    titles = results.locator("h1").all_inner_texts()
    page.close()
    assert "Trust: what an answer promises" in titles
    assert {urlsplit(url).netloc for url in asked if url[:5] != "data:"} == {address[7:]}
