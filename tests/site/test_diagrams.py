"""Tests of diagrams: parsing, layout and SVG."""

from __future__ import annotations

import re
from itertools import combinations
from pathlib import Path
from xml.etree import ElementTree

import pytest

from tools.site.diagrams import (
    Link,
    layered,
    read_diagram,
    svg_of,
)

DOCS = Path(__file__).resolve().parents[2] / "docs"
FIGURES = [
    (page.name, text)
    for page in sorted(DOCS.glob("*.md"))
    for text in re.findall(r"```mermaid\n(.*?)```", page.read_text(), re.DOTALL)
]
STATES = """
flowchart TD
  accTitle: A job
  queued(queued) -->|claim| running["running<br>leased"]
  running --> done[(done)]
  running -.->|lease ends| queued
"""


def test_a_text_is_read_as_nodes_and_edges() -> None:
    found = read_diagram(STATES)
    assert (found.title, found.across) == ("A job", False)
    assert {one.name: (one.lines, one.shape) for one in found.nodes.values()} == {
        "queued": (("queued",), "round"),
        "running": (("running", "leased"), "box"),
        "done": (("done",), "store"),
    }
    assert found.links == [
        Link("queued", "running", ("claim",), False),
        Link("running", "done", (), False),
        Link("running", "queued", ("lease ends",), True),
    ]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("graph LR\n a --> b", "Start with `flowchart LR`"),
        ("flowchart LR\n accTitle: t\n a ==> b", "is not a node"),
        ("flowchart LR\n a --> b", "has no title"),
        ("flowchart LR\n accTitle: t\n a --> a", "from a node to itself"),
    ],
)
def test_what_cannot_be_drawn_is_refused(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        read_diagram(text)


@pytest.mark.parametrize(("page", "text"), FIGURES)
def test_figures_of_the_pages_are_whole_and_nothing_overlaps(page: str, text: str) -> None:
    diagram = read_diagram(text)
    found = layered(diagram)
    boxes = [one for one in found.nodes if one.lines]
    assert len(boxes) == len(diagram.nodes) + sum(bool(one.lines) for one in diagram.links)
    for a, b in combinations(boxes, 2):
        apart_x = abs(a.x - b.x) - (a.width + b.width) / 2
        apart_y = abs(a.y - b.y) - (a.height + b.height) / 2
        assert max(apart_x, apart_y) > 0, (page, a.lines, b.lines)
    for one in boxes:
        assert one.width / 2 <= one.x <= found.width - one.width / 2
        assert one.height / 2 <= one.y <= found.height - one.height / 2
    picture = ElementTree.fromstring(svg_of(diagram, "x"))
    svg = "{http://www.w3.org/2000/svg}"
    texts = {one.text for one in picture.iter(f"{svg}text")}
    assert texts == {line for one in boxes for line in one.lines}
    arrows = [one for one in picture.iter(f"{svg}path") if "marker-end" in one.attrib]
    assert len(arrows) == len(diagram.links)
    assert picture.findtext(f"{svg}title") == diagram.title
