"""Tests of the pages' language against CONTRIBUTING.md, by counts."""

import re
from pathlib import Path
from statistics import median

import pytest

ROOT = Path(__file__).resolve().parent.parent
#: Pages that were edited sentence by sentence; add a page after editing it.
EDITED = [
    "CONTRIBUTING.md",
    "README.md",
    "docs/getting_started.md",
    "docs/library.md",
    "docs/dependencies.md",
    "docs/architecture.md",
    "docs/limits.md",
    "docs/reference.md",
    "docs/security.md",
    "docs/upgrading.md",
    "docs/operations.md",
    "docs/deployment.md",
    "docs/fault_injection.md",
    "docs/reliability.md",
    "docs/trust.md",
    "docs/dashboard.md",
    "docs/api.md",
    "docs/clouds.md",
    "docs/recordings.md",
    "docs/exports.md",
    "docs/tracker.md",
    "docs/offline.md",
    "docs/associations.md",
    "docs/coverage.md",
    "docs/surface.md",
    "docs/reconstruction.md",
    "docs/uncertainty.md",
    "docs/viewers.md",
    "docs/from_bag_to_pose.md",
    "docs/whole_maps.md",
    "docs/model.md",
    "docs/paper.md",
    "examples/README.md",
    "client/README.md",
    "ros2/sceneprint_ros/README.md",
    "docs/performance.md",
    "docs/evaluation.md",
    "docs/troubleshooting.md",
    *(f"docs/sensors/{path.name}" for path in sorted((ROOT / "docs/sensors").glob("*.md"))),
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
    found = []
    for part in re.split(r"\n\s*\n|\n(?=\s*(?:[*-]|\d+\.) )", page):
        text = re.sub(r"^\s*(?:[*-]|\d+\.) ", "", part)
        found += re.split(r"(?<=[.!?])[)*\"]*\s+(?=[A-Z\d(*\"]|code)", " ".join(text.split()))
    return [one for one in found if re.search(r"\w", one)]


def words(sentence):
    return len([word for word in sentence.split() if re.search(r"\w", word)])


@pytest.mark.parametrize("name", EDITED)
def test_edited_pages_are_in_short_sentences(name):
    found = sentences((ROOT / name).read_text())
    assert [one for one in found if words(one) > MOST_WORDS] == []
    assert median(map(words, found)) <= MEDIAN_WORDS


@pytest.mark.parametrize("name", EDITED)
def test_edited_pages_have_no_phrase_that_readers_stumble_over(name):
    assert STUMBLES.findall(" ".join(sentences((ROOT / name).read_text()))) == []
