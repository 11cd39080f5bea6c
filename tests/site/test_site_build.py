"""The built site: no warning, no dead link, nothing from another host; searched in a browser."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from functools import partial
from html.parser import HTMLParser
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import unquote, urlsplit

import pytest

from tools.site.hooks import RANKED_LAST
from tools.site.reference import generated_pages

if TYPE_CHECKING:
    from playwright.sync_api import Browser

ROOT = Path(__file__).resolve().parents[2]
#: What axe finds in the theme's own markup (two landmarks of one name, tables that scroll and that
#: Chromium focuses without being told), and in tables whose columns need no titles.
KNOWN = {"landmark-unique", "scrollable-region-focusable", "empty-table-header"}


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
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

    def __init__(self, text: str) -> None:
        super().__init__()
        self.links: list[str] = []
        self.loads: list[str] = []
        self.anchors: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        self.anchors |= {given[name] for name in ("id", "name") if name in given}
        if "src" in given:
            self.loads.append(given["src"])
        if "href" in given and tag == "link" and given.get("rel") != "canonical":
            self.loads.append(given["href"])
        elif "href" in given and tag == "a":
            self.links.append(given["href"])


@pytest.fixture(scope="module")
def read(site: Path) -> dict[Path, PageReader]:
    return {path: PageReader(path.read_text()) for path in site.rglob("*.html")}


def test_every_page_is_there(site: Path, read: dict[Path, PageReader]) -> None:
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


def test_no_link_and_no_anchor_is_dead(site: Path, read: dict[Path, PageReader]) -> None:
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


def test_nothing_is_loaded_from_another_host(site: Path, read: dict[Path, PageReader]) -> None:
    loaded = {url for page in read.values() for url in page.loads}
    assert {url for url in loaded if urlsplit(url).netloc} == set()
    styles = "".join(path.read_text() for path in site.rglob("*.css"))
    found = re.findall(r"url\(([^)]*)\)|@import\s+([^;]+)", styles)
    assert {one for pair in found for one in pair if "//" in one and "data:" not in one} == set()


def test_figures_are_drawn_while_the_site_is_built(read: dict[Path, PageReader]) -> None:
    texts = [path.read_text() for path in read]
    assert sum(text.count('<figure class="diagram"') for text in texts) == 5
    assert not any('class="mermaid"' in text for text in texts)


def test_no_list_and_no_table_is_left_as_text(site: Path) -> None:
    """As one would be that git hosts understand and Python-Markdown does not."""
    code = re.compile(r"<(pre|code|script)\b.*?</\1>", re.DOTALL)
    left = [
        f"{path.relative_to(site)}: {line}"
        for path in sorted(site.rglob("*.html"))
        for line in re.findall(
            r"^\s*(?:\|.*\||[*-] \w.*|\d+\. \w.*)$", code.sub("", path.read_text()), re.MULTILINE
        )
    ]
    assert left == []


class _QuietHandler(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        """Say nothing."""


@pytest.fixture(scope="module")
def address(site: Path) -> Iterator[str]:
    """Where the site is served."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(_QuietHandler, directory=str(site)))
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_address[1]}"
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    from playwright.sync_api import sync_playwright

    names = ("chromium", "chromium-browser", "google-chrome")
    chromium = next((path for name in names if (path := shutil.which(name))), None)
    if chromium is None:
        pytest.skip("needs Chromium: apt install chromium")
    with sync_playwright() as playwright:
        one = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        yield one
        one.close()


#: What newcomers type, and the pages of which one has to be among the first three results.
QUESTIONS = {
    "realsense": "sensors/realsense",
    "image_rect_raw": "sensors/realsense",
    "zed_node": "sensors/zed",
    "azure kinect depth image": "sensors/azure_kinect",
    "orbbec gemini launch": "sensors/orbbec",
    "oak-d stereo": "sensors/oak",
    "zed point cloud": "sensors/zed",
    "iphone lidar": "sensors/iphone",
    "velodyne topic": "sensors/velodyne",
    "ouster timestamp": "sensors/ouster",
    "livox custommsg": "sensors/livox",
    "hesai imu": "sensors/hesai",
    "tf_static missing": "troubleshooting",
    "no poses": "troubleshooting",
    "not_found every time": "troubleshooting",
    "ambiguous everywhere": "troubleshooting",
    "wrong frame": "troubleshooting",
    "depth scale": "troubleshooting",
    "infrared instead of depth": "troubleshooting",
    "jobs stay queued": "troubleshooting",
    "api key refused": "troubleshooting",
    "507": "troubleshooting",
    "gpu": "troubleshooting",
    "first query slow": "troubleshooting",
    "two robots one map": "associations",
    "upload rosbag": "recordings",
    "install": "getting_started",
    "nav2": "ros2/sceneprint_ros/index",
    "covariance": "uncertainty",
}
#: Asks the worker that the page itself searches with; its messages are numbered in this order.
ASK = """async (questions) => {
    const [SETUP, , QUERY] = [0, 1, 2];
    const {base, search} = JSON.parse(document.getElementById("__config").textContent);
    const root = new URL(`${base}/`, location);
    const worker = new Worker(new URL(search, root));
    const ask = (type, data) => new Promise((resolve, reject) => {
        worker.onmessage = (event) => resolve(event.data.data);
        worker.onerror = reject;
        worker.postMessage({type, data});
    });
    const index = await (await fetch(new URL("search/search_index.json", root))).json();
    await ask(SETUP, {...index, options: {suggest: false}});
    const found = {};
    for (const question of questions) {
        const {items} = await ask(QUERY, question);
        found[question] = items.map(([page]) => page.location.split(".html")[0]);
    }
    return found;
}"""


def test_the_search_leads_newcomers_to_the_right_page(address: str, browser: Browser) -> None:
    page = browser.new_page()
    page.goto(f"{address}/index.html")
    found = page.evaluate(ASK, [*QUESTIONS, "evaluation"])
    page.close()
    firsts = {question: found[question][:3] for question in QUESTIONS}
    assert {one: firsts[one] for one in QUESTIONS if QUESTIONS[one] not in firsts[one]} == {}
    # pages of measurements are found, after all others
    last = found["evaluation"]
    measured = [one for one in last if f"docs/{one}.md" in RANKED_LAST]
    assert "evaluation" in measured
    assert last[-len(measured) :] == measured


@pytest.mark.thorough
@pytest.mark.parametrize(("scheme", "width"), [("light", 1280), ("dark", 1280), ("light", 390)])
def test_pages_are_read_and_searched_in_a_browser(
    address: str, browser: Browser, scheme: str, width: int
) -> None:
    from axe_playwright_python.sync_playwright import Axe

    asked: list[str] = []
    page = browser.new_page(
        color_scheme=scheme, viewport={"width": width, "height": 900}  # type: ignore[arg-type]
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
