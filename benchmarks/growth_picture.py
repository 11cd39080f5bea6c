"""The curves of `benchmarks.growth` as one picture: what was measured, and lines on paper."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.curves import Line
from benchmarks.growth_page import ON_PAPER, GrowthFigures, lines_of
from sceneprint.evaluation.plots import new_figure, save_figure

COLOURS = {
    "search": "#2b6cb0",
    "exact scan": "#8a8f98",
    "append 1,000": "#c2a14d",
    "refit": "#d9772b",
    "open": "#2f9e63",
    "held": "#2b6cb0",
    "mapped": "#8a8f98",
    "index": "#2b6cb0",
    "database": "#c2a14d",
    "uploads and artifacts": "#8a8f98",
}
LABELS = {
    "search": "search from a shortlist",
    "append 1,000": "publish 1,000 more",
    "refit": "publish with a new fit",
    "open": "open, new process",
    "held": "held by the process",
    "mapped": "mapped signatures in use",
}


def draw(figures: GrowthFigures, path: Path) -> None:
    """Time, memory and disk of the smallest signatures against the number of frames."""
    length = min(figures.curves)
    points = figures.curves[length]
    ns, fitted = [p.frames for p in points], lines_of(points)
    figure = new_figure(12.6, 4.6)
    axes = figure.subplots(1, 3)
    for name in points[0].milliseconds:
        _curve(axes[0], name, ns, [p.milliseconds[name] / 1e3 for p in points], fitted[name], 1e-3)
    for name in points[0].megabytes:
        line = fitted[name] if name == "held" else None
        _curve(axes[1], name, ns, [p.megabytes[name] / 1e3 for p in points], line, 1e-3)
    disk = [p.disk * p.frames / 1e9 for p in points]
    _curve(axes[2], "index", ns, disk, fitted["disk"], 1e-3)
    for one in figures.disk:
        if one.signature_bytes == length:
            _curve(axes[2], "database", [], [], Line(0, one.database), 1e-9)
            each = one.uploads + one.artifacts
            _curve(axes[2], "uploads and artifacts", [], [], Line(0, each), 1e-9)
    titles = ("Time, s", "Memory of a process that searched, GB", "Disk, GB")
    for axis, title in zip(axes, titles, strict=True):
        _plain(axis, title)
    figure.suptitle(
        f"Growth of a map, signatures of {length:,} bytes: measured (points) and on paper (dashed)",
        x=0.01,
        ha="left",
        fontsize=12,
    )
    save_figure(figure, path)


def _curve(
    axis: Any, name: str, ns: list[int], values: list[float], line: Line | None, scale: float
) -> None:
    colour, label = COLOURS[name], LABELS.get(name, name)
    if ns:
        axis.plot(ns, values, "o-", color=colour, lw=2, ms=4, label=label)
    if line is not None:
        x = np.geomspace(ns[-1] if ns else 1e3, ON_PAPER[-1], 50)
        style = None if ns else label
        axis.plot(x, [scale * line.at(n) for n in x], "--", color=colour, lw=1.4, label=style)


def _plain(axis: Any, title: str) -> None:
    axis.set(xscale="log", yscale="log", xlim=(8e2, 1.3e7), xlabel="frames in the map")
    axis.set_xticks([10.0**k for k in range(3, 8)], ["1k", "10k", "100k", "1M", "10M"])
    axis.set_title(title, loc="left", fontsize=11)
    axis.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axis.spines[["top", "right"]].set_visible(False)
    axis.grid(which="major", color="#e8eaee", lw=0.8)
    axis.minorticks_off()
    axis.set_axisbelow(True)
    axis.legend(frameon=False, fontsize=9, loc="upper left")
