"""A contact sheet: a few queries, each with the first matches of R, DR and VDR.

outcomes  --contact_sheet-->  matplotlib Figure
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sceneprint.evaluation.plots import RIGHT, UNDECIDED, WRONG, new_figure
from sceneprint.evaluation.records import VIEWS, Outcome, Pair
from sceneprint.geometry.retrieval import similarity
from sceneprint.types import AnyFrame, Bytes, Cloud, Floats32

if TYPE_CHECKING:
    from collections.abc import Callable

    from matplotlib.figure import Figure

QUERIES, ROWS = 6, ("R", "DR", "VDR")


def contact_sheet(
    outcomes: Sequence[Outcome],
    query: Callable[[int], AnyFrame],
    database: Callable[[int], AnyFrame],
    unrelated_distance: float | None,
) -> Figure:
    """Six queries, evenly chosen, beside five matches of each row.

    The border tells what became of a match: green accepted and right, red accepted and
    wrong, grey not accepted. The caption has similarity (or rank) and true overlap.

    Parameters
    ----------
    outcomes : of all queries
    query, database : give the frame of an index
    unrelated_distance : of the model, for similarities; None where it has none for the metric
    """
    chosen = sorted(set(np.linspace(0, len(outcomes) - 1, QUERIES).round().astype(int).tolist()))
    columns = min(2, len(chosen))
    lines = -(-len(chosen) // columns)
    figure = new_figure(9.0 * columns, 4.2 * lines + 0.4)
    blocks = np.array(figure.subfigures(lines, columns, squeeze=False)).ravel()
    for block, number in zip(blocks, chosen, strict=False):
        outcome = outcomes[number]
        block.suptitle(
            outcome.name, x=0.01, ha="left", fontsize=11, fontweight="bold",
            parse_math=False,  # a name may hold a $
        )  # fmt: skip
        axes = block.subplots(len(ROWS), VIEWS + 1, squeeze=False)
        frame = query(number)
        for row, line in zip(ROWS, axes, strict=True):
            for cell in line:
                cell.set_xticks([])
                cell.set_yticks([])
                cell.spines[:].set_visible(False)
            line[0].set_ylabel(row, fontsize=11, rotation=0, ha="right", va="center")
            if row == ROWS[0]:
                _thumbnail(line[0], frame, "#111111")
                line[0].set_title("query", fontsize=8, pad=2)
            for cell, pair in zip(line[1:], outcome.views(row)[:VIEWS], strict=False):
                _thumbnail(cell, database(pair.match), _colour(pair))
                cell.set_title(_caption(outcome, pair, unrelated_distance), fontsize=7.5, pad=2)
    figure.suptitle(
        "Border green: accepted, and right to 10 cm and 10 degrees.  Red: accepted, and wrong.  "
        "Grey: not accepted.  #: rank, s: similarity.",
        x=0.01, ha="left", fontsize=10, color="#444444",
    )  # fmt: skip
    return figure


def depth_colours(frame: AnyFrame, width: int = 160) -> Bytes:
    """(h, width, 3) uint8: near warm, far cool, missing dark; of a cloud all round, z up."""
    from matplotlib import colormaps

    if isinstance(frame, Cloud):
        depth = _panorama(frame, width)
    else:
        step = max(frame.depth.shape[1] // width, 1)
        depth = frame.depth[::step, ::step]
    seen = depth > 0
    low, high = np.percentile(depth[seen], [2, 98]) if seen.any() else (0.0, 1.0)
    level = np.clip((high - depth) / max(high - low, 1e-6), 0, 1)
    colours: Bytes = (255 * colormaps["turbo"](level)[..., :3]).astype(np.uint8)
    colours[~seen] = 40
    return colours


def _panorama(cloud: Cloud, width: int) -> Floats32:
    """(width / 2, width) metres: the nearest point in each direction, 0 where there is none."""
    points = cloud.points.astype(float)
    far = np.linalg.norm(points, axis=1)
    points, far = points[far > 0], far[far > 0]
    cell = 2 * np.pi / width
    x = ((np.pi - np.arctan2(points[:, 1], points[:, 0])) / cell).astype(int) % width
    y = np.minimum(((np.pi / 2 - np.arcsin(points[:, 2] / far)) / cell).astype(int), width // 2 - 1)
    nearest = np.full((width // 2, width), np.inf)
    np.minimum.at(nearest, (y, x), far)
    return np.where(np.isfinite(nearest), nearest, 0.0).astype(np.float32)


def _thumbnail(cell: Any, frame: AnyFrame, colour: str) -> None:
    cell.imshow(depth_colours(frame), aspect="equal")
    cell.spines[:].set(visible=True, color=colour, linewidth=3)


def _colour(pair: Pair) -> str:
    if not pair.accepted:
        return UNDECIDED
    return RIGHT if pair.right else WRONG


def _caption(outcome: Outcome, pair: Pair, unrelated_distance: float | None) -> str:
    rank = outcome.ranking.index(pair.match)
    near = f"rank {rank + 1}"
    if unrelated_distance is not None:
        value = similarity(outcome.distances[rank : rank + 1], unrelated_distance)
        near = f"#{rank + 1}  s {float(value[0]):.2f}"
    return f"{near}  overlap {pair.overlap_mean:.2f}"
