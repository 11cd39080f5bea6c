"""Diagrams from text: what is read, where nodes are put, what is drawn."""

from __future__ import annotations

import re
from itertools import combinations, pairwise
from pathlib import Path
from xml.etree import ElementTree

import pytest

from tools.site.diagrams import (
    Diagram,
    LayeredGraph,
    Link,
    crossings,
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


def read(text: str) -> Diagram:
    return read_diagram(f"flowchart LR\naccTitle: t\n{text}")


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
        ("graph LR\n a --> b", "begin with `flowchart LR`"),
        ("flowchart LR\n accTitle: t\n a ==> b", "is no node, no edge"),
        ("flowchart LR\n a --> b", "needs a line `accTitle"),
        ("flowchart LR\n accTitle: t\n a --> a", "leads back to its node"),
    ],
)
def test_what_cannot_be_drawn_is_refused(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        read_diagram(text)


def test_layers_follow_the_longest_way_and_an_edge_that_closes_a_circle_goes_back() -> None:
    diagram = read("a --> b\nb --> c\na --> c\nc --> a")
    found = layered(diagram)
    assert {one.name: one.layer for one in diagram.nodes.values()} == {"a": 0, "b": 2, "c": 4}
    names = [[one.name for one in route] for route in found.routes]
    assert names[0] == ["a", "0.1", "b"]
    assert names[2] == ["a", "2.1", "2.2", "2.3", "c"]
    assert names[3] == ["c", "3.3", "3.2", "3.1", "a"]  # from its source to its target
    assert diagram.nodes["a"].x < diagram.nodes["b"].x < diagram.nodes["c"].x


def naive_crossings(found: LayeredGraph, across: bool) -> int:
    """By the places of the ends: segments between the same two layers, in another order."""
    segments = [
        sorted((a, b), key=lambda one: one.layer)
        for route in found.routes
        for a, b in pairwise(route)
    ]
    side = (lambda one: one.y) if across else (lambda one: one.x)
    return sum(
        (side(a) < side(c)) != (side(b) < side(d))
        for (a, b), (c, d) in combinations(segments, 2)
        if a.layer == c.layer and a is not c and b is not d
    )


def test_edges_cross_only_where_they_must() -> None:
    twisted = read("a --> y\nb --> x\na --> z\nc --> x")
    assert naive_crossings(layered(twisted), True) == 0
    # three to three, all with all: nine at least between two layers (Zarankiewicz)
    full = read("\n".join(f"{a} --> {b}" for a in "abc" for b in "xyz"))
    assert naive_crossings(layered(full), True) == 9


def test_crossings_are_counted_between_neighbouring_layers() -> None:
    diagram = read("a --> x\nb --> y")
    found = layered(diagram)
    by_layer = [[one for one in found.nodes if one.layer == layer] for layer in range(3)]
    assert crossings(by_layer, found.routes) == 0
    by_layer[2].reverse()
    assert crossings(by_layer, found.routes) == 1


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


def test_which_figures_are_drawn() -> None:
    assert [page for page, _ in FIGURES] == ["architecture.md"] * 3 + ["deployment.md", "trust.md"]


def test_an_arrow_ends_at_the_border_of_its_node() -> None:
    diagram = read('a --> b["one<br>two"]')
    svg = svg_of(diagram, "x")
    b = diagram.nodes["b"]
    assert (b.width, b.height) == (3 * 7 + 28, 2 * 17 + 18)
    (path,) = re.findall(r'<path d="(M[^"]*)" marker-end="url\(#arrow-x\)"', svg)
    *_, x, y = map(float, re.findall(r"[\d.]+", path))
    assert x == pytest.approx(b.x - b.width / 2, abs=0.06)
    assert y == pytest.approx(b.y, abs=0.06)
