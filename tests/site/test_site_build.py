"""Tests of the built site: warnings, which name dead links, and content of other hosts."""

import os
import re
import subprocess
import sys
from pathlib import Path
from urllib.parse import urlsplit

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


def test_nothing_is_loaded_from_another_host(site):
    pages = [path.read_text() for path in site.rglob("*.html")]
    tags = [tag for page in pages for tag in re.findall(r"<[^>]+>", page)]
    loaded = [text for tag in tags for text in re.findall(r'\bsrc="([^"]*)"', tag)]
    links = [tag for tag in tags if tag.startswith("<link") and 'rel="canonical"' not in tag]
    loaded += [text for tag in links for text in re.findall(r'\bhref="([^"]*)"', tag)]
    assert len(loaded) > len(pages) > 10
    assert {url for url in loaded if urlsplit(url).netloc} == set()
    styles = "".join(path.read_text() for path in site.rglob("*.css"))
    matches = re.findall(r"url\(([^)]*)\)|@import\s+([^;]+)", styles)
    assert {one for pair in matches for one in pair if "//" in one and "data:" not in one} == set()
