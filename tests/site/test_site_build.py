"""Tests of the built site: warnings, links, external content, and search in a browser."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

pytestmark = pytest.mark.thorough  # builds the site, which takes longest of all

ROOT = Path(__file__).resolve().parents[2]


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
