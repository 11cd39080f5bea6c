"""Curves and bars of an evaluation.

outcomes  --accuracy_figure, acceptance_figure, diversity_figure-->  matplotlib Figure
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sceneprint.evaluation.measures import bound_of, first_error
from sceneprint.evaluation.records import Error, Outcome, Pair
from sceneprint.types import Floats
from sceneprint.writing import write_whole

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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


def accuracy_figure(outcomes: Sequence[Outcome]) -> Figure:
    """Share of queries whose pose is right to x cm and 10 degrees, for every row."""
    here = [o for o in outcomes if o.present]
    of: dict[str, Callable[[Outcome], Error]] = {
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


def acceptance_figure(outcomes: Sequence[Outcome]) -> Figure:
    """Precision and recall when each evidence decides alone, and of the decision by overlap."""
    pairs = [p for o in outcomes for p in o.pairs.values()]
    found = [p for p in pairs if p.validation.T_match_query is not None]
    figure = new_figure(12.5, 7.2)
    axes = figure.subplots(2, 3).ravel()
    _sweep(axes[0], found, [100 * p.validation.residual_m for p in found], 10, "residual, cm")
    degrees = [math.degrees(p.validation.residual_rad) for p in found]
    _sweep(axes[1], found, degrees, 10, "residual, degrees")
    seen = [(p, v) for p in found if (v := p.validation.violations) is not None]
    pairs_seen, violations = [p for p, _ in seen], [v for _, v in seen]
    _sweep(axes[2], pairs_seen, violations, 0.2, "free-space violations")
    _sweep(axes[3], found, [p.validation.overlap for p in found], 1, "overlap", least=True)
    _sweep(axes[4], found, [p.validation.ambiguity for p in found], 0.2, "ambiguity")
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


def _sweep(
    axes: Any, pairs: list[Pair], values: list[float], top: float, name: str, *, least: bool = False
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


def _bins(axes: Any, pairs: list[Pair]) -> None:
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
