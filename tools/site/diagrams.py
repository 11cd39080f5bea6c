"""Diagrams from text: SVG for the part of mermaid's flowcharts that the pages use.

Git hosts draw mermaid in the browser with their own script. The site draws it during the build, so
that a page needs no script and the diagram follows the theme.

    flowchart LR
      accTitle: What the picture shows
      robot[Robot] -->|frames| service(Service)
      service -.-> store[("Database<br>and blobs")]

    text  --read_diagram-->  Diagram  --layered-->  LayeredGraph  --svg_of-->  SVG
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from html import escape
from itertools import combinations, pairwise

#: Height of a line of text, and mean width of a letter, pixels.
LINE, LETTER = 17.0, 7.0
#: Padding around the text of a node, and gaps within and between layers, pixels.
PAD_X, PAD_Y, BESIDE, BETWEEN = 14.0, 9.0, 22.0, 26.0
_SHAPES = {"[(": "store", "[": "box", "(": "round"}
_NODE = r'(\w+)(?:(\[\(|\[|\()"?([^"\])]*)"?[\])]+)?'
_EDGE = re.compile(rf"^{_NODE}\s*(-->|-\.->)(?:\|([^|]*)\|)?\s*{_NODE}$")
_ALONE = re.compile(rf"^{_NODE}$")
_HEAD = re.compile(r"^flowchart (LR|TD)$")


@dataclass
class Node:
    """A node of a diagram, or (without a shape) a point on the route of an edge.

    Parameters
    ----------
    name : unique name
    lines : lines of its text
    shape : box, round or store; "" for a point of a route
    width, height : pixels
    layer : index of the layer along the direction of the edges
    x, y : position of the centre, pixels
    """

    name: str
    lines: tuple[str, ...] = ()
    shape: str = ""
    layer: int = 0
    x: float = 0.0
    y: float = 0.0
    width: float = 0.0
    height: float = 0.0

    def __post_init__(self) -> None:
        """Set the size from that of the text."""
        pad_x, pad_y = (PAD_X, PAD_Y) if self.shape else (5.0, 2.0)
        if self.lines:
            self.width = max(map(len, self.lines)) * LETTER + 2 * pad_x
            self.height = len(self.lines) * LINE + 2 * pad_y


@dataclass(frozen=True)
class Link:
    """An edge of a diagram.

    Parameters
    ----------
    source, target : names of nodes
    lines : lines of its label
    dashed : whether the edge is dashed
    """

    source: str
    target: str
    lines: tuple[str, ...]
    dashed: bool


@dataclass
class Diagram:
    """A directed graph that a text describes.

    Parameters
    ----------
    title : description for people who cannot see the diagram
    across : whether edges go from left to right instead of down
    nodes : nodes by name, in the order of the text
    links : edges in the order of the text
    """

    title: str
    across: bool
    nodes: dict[str, Node] = field(default_factory=dict)
    links: list[Link] = field(default_factory=list)


def read_diagram(text: str) -> Diagram:
    """Return the diagram that a text describes.

    Raises
    ------
    ValueError : If a line is not supported, or the title is missing.
    """
    first, *rest = [line.strip() for line in text.strip().splitlines() if line.strip()]
    head = _HEAD.match(first)
    if head is None:
        raise ValueError(f"{first!r}: Start with `flowchart LR` or `flowchart TD`.")
    diagram = Diagram("", head[1] == "LR")
    for line in rest:
        edge = _EDGE.match(line)
        alone = _ALONE.match(line)
        if line.startswith("accTitle:"):
            diagram.title = line.partition(":")[2].strip()
        elif edge is not None:
            source = _add_node(diagram, *edge.group(1, 2, 3))
            target = _add_node(diagram, *edge.group(6, 7, 8))
            if source == target:
                raise ValueError(f"{line!r}: An edge from a node to itself is not supported.")
            diagram.links.append(Link(source, target, _lines(edge[5] or ""), edge[4] == "-.->"))
        elif alone is not None:
            _add_node(diagram, *alone.group(1, 2, 3))
        else:
            raise ValueError(f"{line!r} is not a node, an edge or `accTitle: ...`.")
    if not diagram.title:
        raise ValueError("The diagram has no title. Add a line `accTitle: ...`.")
    return diagram


def _add_node(diagram: Diagram, name: str, shape: str | None, text: str | None) -> str:
    """Add a node at its first use, and set its text when a line defines it."""
    if name not in diagram.nodes or shape:
        diagram.nodes[name] = Node(name, _lines(text or name), _SHAPES[shape or "["])
    return name


def _lines(text: str) -> tuple[str, ...]:
    return tuple(re.split(r"<br\s*/?>", text.strip())) if text.strip() else ()


@dataclass
class LayeredGraph:
    """A diagram with positions of its nodes.

    Parameters
    ----------
    nodes : nodes of the diagram, and points on the routes of edges
    routes : nodes of each link's route, from its source to its target
    width, height : pixels
    """

    nodes: list[Node]
    routes: list[list[Node]]
    width: float = 0.0
    height: float = 0.0


def layered(diagram: Diagram) -> LayeredGraph:
    """Return nodes in layers along the direction of the edges (Sugiyama et al.).

    Only edges that close a cycle lead backward. Labels of edges have separate layers, so that they
    overlap nothing.
    """
    backward = set(_cycle_links(diagram))
    _assign_layers(diagram, backward)
    graph = LayeredGraph(list(diagram.nodes.values()), [])
    for number, link in enumerate(diagram.links):
        ends = [diagram.nodes[link.source], diagram.nodes[link.target]]
        if number in backward:
            ends.reverse()
        route = list(_route(ends[0], ends[1], link, number))
        graph.nodes += route[1:-1]
        graph.routes.append(route[::-1] if number in backward else route)
    layers = _order_layers(graph)
    _place(graph, layers, diagram.across)
    return graph


def _cycle_links(diagram: Diagram) -> Iterator[int]:
    """Yield the indices of the links that close a cycle."""
    leaving = defaultdict(list)
    for number, link in enumerate(diagram.links):
        leaving[link.source].append((number, link.target))
    done: set[str] = set()
    links = []

    def visit(name: str, above: frozenset[str]) -> None:
        for number, target in leaving[name]:
            if target in above:
                links.append(number)
            elif target not in done:
                visit(target, above | {target})
        done.add(name)

    for name in diagram.nodes:
        if name not in done:
            visit(name, frozenset({name}))
    yield from links


def _assign_layers(diagram: Diagram, backward: set[int]) -> None:
    """Put each node two layers after its last predecessor; labels use the layer between."""
    pairs = [
        (link.target, link.source) if number in backward else (link.source, link.target)
        for number, link in enumerate(diagram.links)
    ]
    changed = True
    while changed:
        changed = False
        for source, target in pairs:
            least = diagram.nodes[source].layer + 2
            if diagram.nodes[target].layer < least:
                diagram.nodes[target].layer = least
                changed = True


def _route(source: Node, target: Node, link: Link, number: int) -> Iterator[Node]:
    """Yield the points of a link's route: one in each layer, the label at the first odd one."""
    yield source
    for layer in range(source.layer + 1, target.layer):
        label = link.lines if layer == source.layer + 1 else ()
        yield Node(f"{number}.{layer}", label, "", layer)
    yield target


def _order_layers(graph: LayeredGraph) -> list[list[Node]]:
    """Return the order of nodes in each layer with the fewest crossings that the sweeps found."""
    layers: list[list[Node]] = [[] for _ in range(max(node.layer for node in graph.nodes) + 1)]
    for node in graph.nodes:
        layers[node.layer].append(node)
    best, fewest = [list(layer) for layer in layers], crossings(layers, graph.routes)
    for sweep in range(24):
        step = 1 if sweep % 2 == 0 else -1
        for before, layer in pairwise(layers[::step]):
            _sort(layer, before, graph.routes)
        count = crossings(layers, graph.routes)
        if count < fewest:
            best, fewest = [list(layer) for layer in layers], count
    return best


def _sort(layer: list[Node], before: list[Node], routes: list[list[Node]]) -> None:
    """Sort a layer by the mean position of each node's neighbours in the layer before."""
    places = {node.name: float(at) for at, node in enumerate(before)}
    near: dict[str, list[float]] = defaultdict(list)
    for route in routes:
        for a, b in pairwise(route):
            for one, other in ((a, b), (b, a)):
                if other.name in places:
                    near[one.name].append(places[other.name])
    weights = {one.name: _mean(near[one.name], float(at)) for at, one in enumerate(layer)}
    layer.sort(key=lambda one: weights[one.name])


def crossings(layers: list[list[Node]], routes: list[list[Node]]) -> int:
    """Return the number of crossings of edges between neighbouring layers."""
    places = {one.name: at for layer in layers for at, one in enumerate(layer)}
    between: dict[int, list[tuple[int, int]]] = defaultdict(list)
    for route in routes:
        for a, b in pairwise(route):
            low, high = sorted((a, b), key=lambda one: one.layer)
            between[low.layer].append((places[low.name], places[high.name]))
    return sum(
        (a - c) * (b - d) < 0
        for edges in between.values()
        for (a, b), (c, d) in combinations(edges, 2)
    )


def _mean(values: Iterable[float], default: float) -> float:
    known = list(values)
    return sum(known) / len(known) if known else default


def _place(graph: LayeredGraph, layers: list[list[Node]], across: bool) -> None:
    """Set the positions of nodes: layer after layer, and near their neighbours within a layer."""
    size = {node.name: (node.height, node.width) if across else (node.width, node.height)
            for node in graph.nodes}  # fmt: skip
    beside = {node.name: 0.0 for node in graph.nodes}
    near: dict[str, list[str]] = defaultdict(list)
    for route in graph.routes:
        for a, b in pairwise(route):
            near[a.name].append(b.name)
            near[b.name].append(a.name)
    for sweep in range(160):
        for layer in layers[:: 1 if sweep % 2 == 0 else -1]:
            wanted = [_mean([beside[o] for o in near[one.name]], beside[one.name]) for one in layer]
            _separate(layer, wanted, beside, {node.name: size[node.name][0] for node in layer})
    low = min(beside[node.name] - size[node.name][0] / 2 for node in graph.nodes)
    along = 2.0
    for layer in layers:
        depth = max(size[node.name][1] for node in layer)
        for node in layer:
            # A layer without labels has no depth; its edges pass the middle of the gap.
            middle = along + (depth / 2 if depth else -BETWEEN / 2)
            places = beside[node.name] - low + 2.0, middle
            node.x, node.y = places[::-1] if across else places
        along += depth + (BETWEEN if depth else 0.0)
    graph.width = max(node.x + node.width / 2 for node in graph.nodes) + 2.0
    graph.height = max(node.y + node.height / 2 for node in graph.nodes) + 2.0


def _separate(
    layer: list[Node], wanted: list[float], beside: dict[str, float], size: dict[str, float]
) -> None:
    """Place the nodes of a layer without overlaps, in order and near their wanted positions.

    Neighbours that would overlap form a block, at the mean of its nodes' wanted positions.
    """
    blocks: list[tuple[list[int], float]] = []
    offsets: list[float] = [0.0]
    for a, b in pairwise(layer):
        offsets.append(offsets[-1] + (size[a.name] + size[b.name]) / 2 + BESIDE)
    for number in range(len(layer)):
        block, at = [number], wanted[number] - offsets[number]
        while blocks and blocks[-1][1] > at:  # in coordinates without the gaps
            block = blocks.pop()[0] + block
            at = _mean([wanted[i] - offsets[i] for i in block], 0.0)
        blocks.append((block, at))
    for block, at in blocks:
        for i in block:
            beside[layer[i].name] = at + offsets[i]


def svg_of(diagram: Diagram, identity: str) -> str:
    """Return the diagram as one line of SVG; a style sheet sets its colours.

    Parameters
    ----------
    diagram : the diagram
    identity : id of its marker, unique on the page
    """
    layout = layered(diagram)
    arrow = f"arrow-{identity}"
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" role="img" viewBox="0 0 {layout.width:.0f} '
        f'{layout.height:.0f}" width="{layout.width:.0f}" height="{layout.height:.0f}">',
        f"<title>{escape(diagram.title)}</title>",
        f'<marker id="{arrow}" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="8" '
        'markerHeight="8" orient="auto" markerUnits="userSpaceOnUse"><path d="M0 0 8 4 0 8z"/>'
        "</marker>",
    ]
    for link, route in zip(diagram.links, layout.routes, strict=True):
        dashed = ' class="dashed"' if link.dashed else ""
        path = _curve(route, diagram.across)
        parts.append(f'<path d="{path}"{dashed} marker-end="url(#{arrow})"/>')
    parts += [_draw_node(node) for node in layout.nodes if node.lines]
    return "".join([*parts, "</svg>"])


def _curve(route: list[Node], across: bool) -> str:
    """Return a smooth path through the centres of the nodes, from border to border."""
    points = [(node.x, node.y) for node in route]
    sign = 1.0 if route[-1].layer > route[0].layer else -1.0
    for at, direction in ((0, sign), (-1, -sign)):
        x, y = points[at]
        half = (route[at].width if across else route[at].height) / 2
        points[at] = (x + direction * half, y) if across else (x, y + direction * half)
    path = f"M{points[0][0]:.1f} {points[0][1]:.1f}"
    for (x0, y0), (x1, y1) in pairwise(points):
        if across:
            middle = (x0 + x1) / 2
            path += f"C{middle:.1f} {y0:.1f} {middle:.1f} {y1:.1f} {x1:.1f} {y1:.1f}"
        else:
            middle = (y0 + y1) / 2
            path += f"C{x0:.1f} {middle:.1f} {x1:.1f} {middle:.1f} {x1:.1f} {y1:.1f}"
    return path


def _draw_node(one: Node) -> str:
    """Return a node's outline and text, or the label of an edge on an opaque background."""
    left, top = one.x - one.width / 2, one.y - one.height / 2
    radius = {"round": one.height / 2, "": 3.0}.get(one.shape, 4.0)
    outline = (
        f'<rect x="{left:.1f}" y="{top:.1f}" width="{one.width:.1f}" height="{one.height:.1f}" '
        f'rx="{radius:.1f}"/>'
    )
    if one.shape == "store":
        lid = f'<path d="M{left:.1f} {top + 6:.1f}h{one.width:.1f}"/>'
        outline += lid
    first = one.y - (len(one.lines) - 1) * LINE / 2
    text = "".join(
        f'<text x="{one.x:.1f}" y="{first + at * LINE:.1f}">{escape(line)}</text>'
        for at, line in enumerate(one.lines)
    )
    return f'<g class="{one.shape or "label"}">{outline}{text}</g>'
