"""Tests of the pages' language against CONTRIBUTING.md, by counts."""

import re
from pathlib import Path
from statistics import median

import pytest

ROOT = Path(__file__).resolve().parent.parent
PAGES = [
    *(ROOT / "docs").rglob("*.md"),
    *map(ROOT.joinpath, ("CONTRIBUTING.md", "README.md", "examples/README.md", "client/README.md")),
    ROOT / "ros2/sceneprint_ros/README.md",
]
MEDIAN_WORDS, MOST_WORDS = 18, 45
#: Phrases that follow another language's syntax, or that CONTRIBUTING.md retires.
STUMBLES = re.compile(
    r"so that no\b|of whom\b|what is none|made anew|is to be had|has to do with|are told\b"
    r"|is told\b|whoever asks|is asked for|is led there|goes on as|tells how|tells of|tells whether"
    r"|in the order of ROS|nothing speaks|by command\b|in passing|it is for the name",
    re.IGNORECASE,
)


def sentences(page):
    """Sentences of the prose of a page: without code, tables, headings and what is generated."""
    page = re.sub(r"^ *```.*?^ *```$", "", page, flags=re.DOTALL | re.MULTILINE)
    page = re.sub(r"<!-- ([\w-]+):begin -->.*<!-- \1:end -->", "", page, flags=re.DOTALL)
    page = re.sub(r"<!--.*?-->", "", page, flags=re.DOTALL)
    page = re.sub(r"^\s*\|.*$|^#.*$|^!\[.*$", "", page, flags=re.MULTILINE)
    page = re.sub(r"`[^`]*`|\[[\w/]+\.md\]\([^)]*\)", "code", page)
    page = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", page)
    page = re.sub(r"\be\.g\.|\bi\.e\.", "such as", page)
    results = []
    for part in re.split(r"\n\s*\n|\n(?=\s*(?:[*-]|\d+\.) )", page):
        text = re.sub(r"^\s*(?:[*-]|\d+\.) ", "", part)
        results += re.split(r"(?<=[.!?])[)*\"]*\s+(?=[A-Z\d(*\"]|code)", " ".join(text.split()))
    return [result for result in results if re.search(r"\w", result)]


def words(sentence):
    return len([word for word in sentence.split() if re.search(r"\w", word)])


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_pages_are_in_short_sentences_that_readers_do_not_stumble_over(page):
    text = page.read_text()
    # no index has our distributions: pip would find nothing, or a package of another owner
    assert re.findall(r"pip install (?:-\S+ )*['\"]?sceneprint", text) == []
    result = sentences(text)
    assert [item for item in result if words(item) > MOST_WORDS] == []
    assert median(map(words, result)) <= MEDIAN_WORDS
    assert STUMBLES.findall(" ".join(result)) == []
