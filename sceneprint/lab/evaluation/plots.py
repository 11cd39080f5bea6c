"""One query's validated views, merged by their estimated transforms into the query's frame.

query, pairs  --merged-->  Cloud  --to_ply, cloud_figure-->  PLY, picture
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sceneprint.atomic_files import write_whole
from sceneprint.formats.export import write_ply
from sceneprint.geometry.retrieval.ranking import similarity
from sceneprint.geometry.rigid import inverse, levelling, moved
from sceneprint.lab.evaluation.measures import (
    FARTHEST,
    bound_of,
    coverage,
    equal_views,
    first_error,
)
from sceneprint.lab.evaluation.protocol import VIEWS, Error, FrameStore, QueryOutcome, ValidatedPair
from sceneprint.lab.evaluation.run import Evaluation
from sceneprint.models import Model
from sceneprint.types import AnyFrame, Bytes, Cloud, DepthFrame, Floats, Floats32

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Curves and bars of an evaluation.
#
# outcomes  --accuracy_figure, acceptance_figure, diversity_figure-->  matplotlib Figure

COLOURS = {
    "R": "#8a8f98",
    "DR": "#c2a14d",
    "VR": "#d9772b",
    "VDR": "#2b6cb0",
    "pose average": "#2f9e63",
    "bound of VDR": "#111111",
}
RIGHT, WRONG, UNDECIDED = "#2f9e63", "#c8372d", "#9aa0a6"
#: Edges of the bins of overlap.
BINS = (0.0, 0.1, 0.2, 0.3, 0.5, 1.0)


def new_figure(width: float, height: float) -> Figure:
    """An empty white figure that no window shows; inches."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: Figure, path: Path, dpi: int = 110) -> None:
    """Write a figure as PNG, the same bytes each time."""
    buffer = BytesIO()
    figure.savefig(buffer, dpi=dpi, format="png", metadata={"Software": None})
    write_whole(path, buffer.getvalue())


def accuracy_figure(outcomes: Sequence[QueryOutcome]) -> Figure:
    """Share of queries whose pose is right to x cm and 10 degrees, for every row."""
    here = [o for o in outcomes if o.present]
    of: dict[str, Callable[[QueryOutcome], Error]] = {
        "R": lambda o: first_error(o, "R"),
        "VR": lambda o: first_error(o, "VR"),
        "VDR": lambda o: first_error(o, "VDR"),
        "pose average": lambda o: o.average,
        "bound of VDR": bound_of,
    }
    figure = new_figure(7.2, 4.6)
    axes = figure.subplots()
    x = np.linspace(0, 0.20, 401)
    for name, error in of.items():
        errors = [error(o) for o in here]
        off = np.array([e.metres if e.radians <= math.radians(10) else np.inf for e in errors])
        share = (off[:, None] <= x).mean(axis=0) if here else np.zeros(len(x))
        dashed = name.startswith("bound")
        axes.plot(
            100 * x, share, color=COLOURS[name], lw=1.4 if dashed else 2, label=name,
            linestyle="--" if dashed else "-",
        )  # fmt: skip
    for threshold in (5, 10):
        axes.axvline(threshold, color="#d0d4da", lw=1, zorder=0)
    axes.set(xlim=(0, 20), ylim=(0, 1.02), xlabel="error of the camera's position, cm")
    axes.set_ylabel("share of queries, within 10 degrees")
    axes.set_title(f"Accuracy of {len(here)} queries", loc="left", fontsize=12)
    _plain(axes)
    axes.legend(frameon=False, loc="lower right")
    return figure


def acceptance_figure(outcomes: Sequence[QueryOutcome]) -> Figure:
    """Precision and recall when each evidence decides alone, and of the decision by overlap."""
    pairs = [p for o in outcomes for p in o.pairs.values()]
    found = [p for p in pairs if p.validation.T_match_query is not None]
    figure = new_figure(12.5, 7.2)
    axes = figure.subplots(2, 3).ravel()
    _threshold_curve(
        axes[0], found, [100 * p.validation.residual_m for p in found], 10, "residual, cm"
    )
    degrees = [math.degrees(p.validation.residual_rad) for p in found]
    _threshold_curve(axes[1], found, degrees, 10, "residual, degrees")
    seen = [(p, v) for p in found if (v := p.validation.violations) is not None]
    pairs_seen, violations = [p for p, _ in seen], [v for _, v in seen]
    _threshold_curve(axes[2], pairs_seen, violations, 0.2, "free-space violations")
    _threshold_curve(
        axes[3], found, [p.validation.overlap for p in found], 1, "overlap", least=True
    )
    _threshold_curve(axes[4], found, [p.validation.ambiguity for p in found], 0.2, "ambiguity")
    _bins(axes[5], pairs)
    axes[0].legend(frameon=False, loc="lower right")
    figure.suptitle(
        f"Acceptance of {len(pairs)} pairs: accepted where one evidence alone is within x, and "
        "(last) as decided",
        x=0.01,
        ha="left",
        fontsize=12,
    )
    return figure


def _threshold_curve(
    axes: Any,
    pairs: list[ValidatedPair],
    values: list[float],
    top: float,
    name: str,
    *,
    least: bool = False,
) -> None:
    """Precision and recall as the threshold on one evidence moves."""
    right: NDArray[np.bool_] = np.array([p.right for p in pairs], bool)
    value: Floats = np.array(values, float)
    x = np.linspace(0, top, 200)
    passed = (value >= x[:, None]) if least else (value <= x[:, None])
    both, accepted = (passed & right).sum(axis=1), passed.sum(axis=1)
    axes.plot(x, np.where(accepted, both / np.maximum(accepted, 1), np.nan), color="#2b6cb0",
              lw=2, label="precision")  # fmt: skip
    axes.plot(x, both / max(right.sum(), 1), color="#d9772b", lw=2, label="recall")
    axes.set(xlim=(0, top), ylim=(0, 1.02), xticks=np.linspace(0, top, 6))
    axes.set_xlabel(f"{name}, {'at least' if least else 'at most'}")
    _plain(axes)


def _bins(axes: Any, pairs: list[ValidatedPair]) -> None:
    """What became of pairs, by how much they truly overlap."""
    labels, heights = [], []
    for low, high in pairwise(BINS):
        inside = [p for p in pairs if low <= p.overlap_least < high or p.overlap_least == high == 1]
        n = max(len(inside), 1)
        right = sum(p.accepted and p.right for p in inside) / n
        heights.append((right, sum(p.accepted for p in inside) / n - right))
        labels.append(f"{low:g}-{high:g}\n{len(inside)}")
    values = np.array(heights)
    place = np.arange(len(labels))
    axes.bar(place, values[:, 0], color=RIGHT, label="accepted, right")
    axes.bar(place, values[:, 1], bottom=values[:, 0], color=WRONG, label="accepted, wrong")
    axes.set_xticks(place, labels)
    axes.set(ylim=(0, 1.2), xlabel="true overlap, and pairs")
    axes.set_yticks(np.linspace(0, 1, 6))
    axes.legend(frameon=False, loc="upper left", ncols=2)
    _plain(axes)


def diversity_figure(figures: dict[str, Any]) -> Figure:
    """The paper's figure: how far the first five lie from the query, and what they cover."""
    figure = new_figure(10.5, 3.9)
    axes = figure.subplots(1, 3)
    rows = ("R", "DR", "VR", "VDR")
    translation = figures["diversity"]["translation"]
    for key, title, panel in (
        ("mean_m", "mean translation, m", axes[0]),
        ("std_m", "its deviation within five, m", axes[1]),
    ):
        _bars(panel, rows, [translation[row][key] or 0.0 for row in rows], title, ".3f")
    covered = figures["diversity"]["coverage"]
    voxels = [(covered[row] or 0) / 1000 for row in ("VR", "VDR")]
    ratio = covered["ratio_of_means"]
    factor = f" (x {ratio:.2f})" if ratio else ""
    _bars(axes[2], ("VR", "VDR"), voxels, f"voxels covered, thousands{factor}", ".1f")
    return figure


def _bars(axes: Any, names: Sequence[str], values: list[float], title: str, form: str) -> None:
    bars = axes.bar(range(len(names)), values, color=[COLOURS[name] for name in names], width=0.7)
    axes.bar_label(bars, fmt=f"%{form}", padding=2, fontsize=9)
    axes.set_xticks(range(len(names)), names)
    axes.set_title(title, loc="left", fontsize=10)
    axes.margins(y=0.12)
    _plain(axes)


def _plain(axes: Any) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", color="#e8eaee", lw=0.8)
    axes.set_axisbelow(True)


#: One for each view, the query's first.
PALETTE = np.array(
    [(90, 96, 105), (43, 108, 176), (217, 119, 43), (47, 158, 99), (160, 80, 170), (196, 160, 50)],
    np.uint8,
)
#: Two neighbouring pixels this much farther apart than wide belong to two surfaces.
_JUMP = 0.05
_SIDE = 700  #: of a rendered view, pixels
_SLAB = 0.10  #: depth within which surfaces count as one, metres


@dataclass(frozen=True, eq=False)
class PatchCloud:
    """Points of several views.

    Parameters
    ----------
    points, normals : (N, 3) metres and unit length, in the query's frame
    of : (N,) the view: 0 the query, then the matches in order
    views : how many, the query not counted
    """

    points: Floats
    normals: Floats
    of: NDArray[np.intp]
    views: int

    @property
    def colours(self) -> Bytes:
        """(N, 3) uint8, one colour for each view."""
        return PALETTE[self.of % len(PALETTE)]


def merged(
    query: DepthFrame, pairs: Sequence[ValidatedPair], database: Callable[[int], DepthFrame]
) -> PatchCloud:
    """The query and its matches, brought to the query's frame; no true pose is used.

    Parameters
    ----------
    query : its depth
    pairs : validated, each with a transform
    database : gives the frame of a database index
    """
    parts = [_oriented(query)]
    for pair in pairs:
        T = pair.validation.T_match_query
        if T is None:
            raise ValueError(f"match {pair.match} has no transform")
        points, normals = _oriented(database(pair.match))
        back = inverse(T)
        parts.append((moved(back, points), normals @ back[:3, :3].T))
    return PatchCloud(
        np.concatenate([p for p, _ in parts]),
        np.concatenate([n for _, n in parts]),
        np.repeat(np.arange(len(parts)), [len(p) for p, _ in parts]),
        len(pairs),
    )


def _oriented(frame: DepthFrame) -> tuple[Floats, Floats]:
    """Points and normals of every second pixel that lies on a smooth surface."""
    k = frame.intrinsics
    y, x = np.mgrid[0 : k.height : 2, 0 : k.width : 2]
    z = frame.depth[::2, ::2].astype(float)
    points = np.stack([(x - k.cx) / k.fx * z, (y - k.cy) / k.fy * z, z], axis=-1)
    right, down = points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1]
    normals = np.cross(down, right)
    length = np.linalg.norm(normals, axis=-1)
    middle, depth = points[1:-1, 1:-1], z[1:-1, 1:-1]
    around = np.stack([z[1:-1, 2:], z[1:-1, :-2], z[2:, 1:-1], z[:-2, 1:-1]])
    smooth = (np.abs(around - depth) < _JUMP * depth).all(axis=0)
    good = (depth > 0) & (depth < FARTHEST) & (around > 0).all(axis=0) & smooth & (length > 0)
    return middle[good], normals[good] / length[good][:, None]


def to_ply(cloud: PatchCloud) -> bytes:
    """Binary PLY: positions in metres, normals, colours."""
    return write_ply(cloud.points, cloud.normals, cloud.colours)


def cloud_figure(name: str, ranked: PatchCloud, diverse: PatchCloud, ratio: float | None) -> Figure:
    """Both clouds from above and at a slant, at one scale; the paper's last figure."""
    figure = new_figure(11.5, 11.0)
    axes = figure.subplots(2, 2)
    everything = np.concatenate([ranked.points, diverse.points])
    level = levelling(np.concatenate([ranked.normals, diverse.normals]))
    for line, cloud, what in (
        (axes[0], ranked, "without diversification (VR)"),
        (axes[1], diverse, "with diversification (VDR)"),
    ):
        for cell, (view, turned) in zip(line, turns().items(), strict=True):
            cell.imshow(rendered(cloud, turned @ level, everything))
            cell.set_axis_off()
            cell.set_title(f"{cloud.views} views {what}, {view}", loc="left", fontsize=10)
    covers = f"; VDR covers {ratio:.2f} times the voxels of VR" if ratio else ""
    figure.suptitle(
        f"{name}{covers}\nvalidated views by their estimated transforms, one colour each, the "
        "query grey",
        x=0.01, ha="left", fontsize=12, parse_math=False,
    )  # fmt: skip
    return figure


def turns() -> dict[str, Floats]:
    """Rotations from the query's frame to a viewer's: x right, y down, z away from him."""
    return {"from above": _about_x(90), "at a slant": _about_x(35) @ _about_y(30)}


def _about_x(degrees: float) -> Floats:
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def _about_y(degrees: float) -> Floats:
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def rendered(cloud: PatchCloud, turned: Floats, scale_of: Floats) -> Bytes:
    """(side, side, 3) uint8: the cloud without perspective, nearest points in front.

    Of views that lie within a slab of each other the earlier one is shown: what a later view
    adds then stands out in its colour.

    Parameters
    ----------
    cloud : what to draw
    turned : (3, 3) rotation to the viewer's axes
    scale_of : (M, 3) points that fill the picture, so that two clouds get one scale
    """
    frame = scale_of @ turned.T
    low, high = np.percentile(frame[:, :2], [0.5, 99.5], axis=0)
    scale = 0.94 * _SIDE / max(float((high - low).max()), 1e-6)
    seen = cloud.points @ turned.T
    pixels = np.rint((seen[:, :2] - (low + high) / 2) * scale + _SIDE / 2).astype(int)
    light = turned.T @ np.array([0.3, -0.5, -0.8])
    light = light / np.linalg.norm(light)
    shade = 0.55 + 0.45 * np.abs(cloud.normals @ light)
    colours = np.clip(cloud.colours * shade[:, None], 0, 255).astype(np.uint8)
    picture = np.full((_SIDE, _SIDE, 3), 255, np.uint8)
    # far first, and in a slab later views first: the last one written stays
    order = np.lexsort((-seen[:, 2], -cloud.of, -np.floor(seen[:, 2] / _SLAB)))
    for dy, dx in ((0, 0), (0, 1), (1, 0), (1, 1)):
        x, y = pixels[order, 0] + dx, pixels[order, 1] + dy
        inside = (x >= 0) & (x < _SIDE) & (y >= 0) & (y < _SIDE)
        picture[y[inside], x[inside]] = colours[order][inside]
    return picture


# A contact sheet: a few queries, each with the first matches of R, DR and VDR.
#
# outcomes  --contact_sheet-->  matplotlib Figure

QUERIES, ROWS = 6, ("R", "DR", "VDR")


def contact_sheet(
    outcomes: Sequence[QueryOutcome],
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


def _colour(pair: ValidatedPair) -> str:
    if not pair.accepted:
        return UNDECIDED
    return RIGHT if pair.right else WRONG


def _caption(outcome: QueryOutcome, pair: ValidatedPair, unrelated_distance: float | None) -> str:
    rank = outcome.ranking.index(pair.match)
    near = f"rank {rank + 1}"
    if unrelated_distance is not None:
        value = similarity(outcome.distances[rank : rank + 1], unrelated_distance)
        near = f"#{rank + 1}  s {float(value[0]):.2f}"
    return f"{near}  overlap {pair.overlap_mean:.2f}"


# Every picture of an evaluation, into a folder.
#
# Evaluation  --save_pictures-->  PNG and PLY files


def save_pictures(
    folder: Path, evaluation: Evaluation, figures: dict[str, Any], store: FrameStore, model: Model
) -> list[Path]:
    """Draw curves, bars, the contact sheet and one query's merged clouds.

    Parameters
    ----------
    folder : must exist
    evaluation : see Evaluation
    figures : as `report.figures` gives them
    store : of the evaluation's frames
    model : that signed them

    Returns
    -------
    paths : of the files written; the clouds are missing where no query has two validated views,
        or those see nothing nearer than `FARTHEST`
    """
    outcomes, prepared = evaluation.outcomes, evaluation.prepared
    used = figures["settings"]
    share = (used["levels"] or len(model.levels)) / len(model.levels)
    d0 = model.unrelated_distance * share if used["metric"] == model.metric else None

    def query(number: int) -> AnyFrame:
        return store.frame(prepared.queries[number])

    def database(match: int) -> AnyFrame:
        return store.frame(prepared.database[match])

    drawn = {
        "accuracy.png": accuracy_figure(outcomes),
        "acceptance.png": acceptance_figure(outcomes),
        "diversity.png": diversity_figure(figures),
        "contact.png": contact_sheet(outcomes, query, database, d0),
    }
    paths = []
    # of depth images alone: what a scanner sees fills no picture of this kind
    depth = all(map(store.is_depth, (*prepared.queries, *prepared.database)))
    chosen = _typical(evaluation, database) if depth else None
    if chosen is not None:
        number, ratio = chosen
        ranked, diverse = (
            merged(_depth(query(number)), pairs[:VIEWS], lambda match: _depth(database(match)))
            for pairs in equal_views(outcomes[number])
        )
        if len(ranked.points) + len(diverse.points):
            drawn["cloud.png"] = cloud_figure(outcomes[number].name, ranked, diverse, ratio)
            for name, cloud in (("cloud-vr.ply", ranked), ("cloud-vdr.ply", diverse)):
                write_whole(folder / name, to_ply(cloud))
                paths.append(folder / name)
    for name, figure in drawn.items():
        save_figure(figure, folder / name)
    return [folder / name for name in drawn] + paths


def _depth(frame: AnyFrame) -> DepthFrame:
    if not isinstance(frame, DepthFrame):
        raise TypeError(f"{frame.name} is no depth image")
    return frame


def _typical(evaluation: Evaluation, database: Any) -> tuple[int, float] | None:
    """The query whose gain in coverage is the median, of those with most views; and the gain."""
    outcomes = evaluation.outcomes
    views = [len(equal_views(outcome)[0]) for outcome in outcomes]
    most = max(views, default=0)
    if most < 2:
        return None
    numbers = [i for i, n in enumerate(views) if n == most]
    covered = coverage([outcomes[i] for i in numbers], database)
    ratios = [pair[1] / pair[0] if pair and pair[0] else 0.0 for pair in covered]
    middle = int(np.argsort(ratios, kind="stable")[len(ratios) // 2])
    return numbers[middle], ratios[middle]
