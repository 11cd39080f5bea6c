"""Pictures of pairs: how well each statistic decides, and the pairs that went wrong.

PairEvaluation, figures  --save_pair_pictures-->  PNG files
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sceneprint.evaluation.clouds import Cloud as Merged
from sceneprint.evaluation.clouds import merged, rendered, turns
from sceneprint.evaluation.contact import depth_colours
from sceneprint.evaluation.frames import Store
from sceneprint.evaluation.pair_drawing import BINS
from sceneprint.evaluation.pair_run import PairEvaluation
from sceneprint.evaluation.pair_trying import Tried
from sceneprint.evaluation.plots import RIGHT, UNDECIDED, WRONG, new_figure, save_figure
from sceneprint.evaluation.registration_baselines import points_of
from sceneprint.geometry.levelling import levelling
from sceneprint.geometry.rigid import inverse, moved
from sceneprint.types import AnyFrame, Bytes, Cloud, Floats, Frame

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Failures that are drawn, and points of a cloud at the most.
DRAWN, POINTS = 8, 50_000
_COLOURS = ("#2b6cb0", "#d9772b", "#2f9e63", "#c8372d", "#111111", "#a050aa", "#8a8f98")


def save_pair_pictures(
    folder: Path, evaluation: PairEvaluation, figures: dict[str, Any], store: Store
) -> list[Path]:
    """Draw curves, bars of success, and some failures of each kind, the worst kind first.

    Parameters
    ----------
    folder : must exist
    evaluation : see PairEvaluation
    figures : as `pair_figures` gives them
    store : of the evaluation's frames

    Returns
    -------
    paths : of the files written; there is none of failures where nothing went wrong
    """
    drawn = {"roc.png": curves_figure(figures), "success.png": success_figure(figures)}
    if figures["failures"]:
        drawn["failures.png"] = failures_figure(
            evaluation, some_of_each(figures["failures"]), store
        )
    for name, figure in drawn.items():
        save_figure(figure, folder / name)
    return [folder / name for name in drawn]


def curves_figure(figures: dict[str, Any]) -> Figure:
    """Share of right and of wrong pairs that pass, for each statistic alone."""
    figure = new_figure(6.4, 5.2)
    axes = figure.subplots()
    for (name, own), colour in zip(figures["roc"].items(), _COLOURS, strict=True):
        if own["curve"]:
            false, true = np.array([row[:2] for row in own["curve"]]).T
            label = f"{name.replace('_', ' ')} {own['area']:.3f}"
            axes.plot(100 * false, true, color=colour, lw=1.8, label=label)
    axes.set(xlim=(-0.5, 25), ylim=(0, 1.02), xlabel="wrong pairs that pass, %")
    axes.set_ylabel("right pairs that pass")
    axes.set_title("Each statistic deciding alone, and area under it", loc="left", fontsize=11)
    axes.spines[["top", "right"]].set_visible(False)
    if axes.lines:
        axes.legend(frameon=False, loc="lower right")
    return figure


def success_figure(figures: dict[str, Any]) -> Figure:
    """Right transforms by true overlap: ours, from the true pose, and of others."""
    rows = {"ours": [figures["bins"][b]["success"] for b in BINS]}
    rows["from the true pose"] = [figures["bins"][b]["bound"] for b in BINS]
    for method, own in figures.get("baselines", {}).get("methods", {}).items():
        rows[f"{method} + ICP"] = [own["bins"][b]["icp"] for b in BINS]
        rows[f"{method} + ours"] = [own["bins"][b]["ours"] for b in BINS]
    figure = new_figure(11.0, 3.9)
    metres, degrees = figures["settings"]["right"]
    keys = {
        "within_5cm_5deg": "5 cm, 5 degrees",
        "right": f"{100 * metres:g} cm, {degrees:g} degrees",
    }
    width = 0.84 / len(rows)
    for panel, (key, title) in zip(figure.subplots(1, 2), keys.items(), strict=True):
        for place, (name, shares) in enumerate(rows.items()):
            at = np.arange(len(BINS)) - 0.42 + (place + 0.5) * width
            values = [share[key] or 0.0 for share in shares]
            panel.bar(at, values, width, color=_COLOURS[place], label=name)
        counts = [figures["bins"][b]["pairs"] for b in BINS]
        names = [f"{b} %\n{n} pairs" for b, n in zip(BINS, counts, strict=True)]
        panel.set_xticks(range(len(BINS)), names)
        panel.set(ylim=(0, 1.02))
        panel.set_title(f"right to {title}", loc="left", fontsize=11)
        panel.spines[["top", "right"]].set_visible(False)
    figure.legend(*panel.get_legend_handles_labels(), loc="outside lower center",
                  ncols=min(3, len(rows)), frameon=False)  # fmt: skip
    return figure


def some_of_each(failures: Sequence[dict[str, Any]], most: int = DRAWN) -> list[dict[str, Any]]:
    """Failures of every kind, as many of each as there are and places for, evenly spread.

    Neighbours in the list are of neighbouring frames, and the first of it all alike.

    Parameters
    ----------
    failures : of `pair_figures`, by kind
    most : of them
    """
    kinds: dict[str, list[dict[str, Any]]] = {}
    for failure in failures:
        kinds.setdefault(failure["what"], []).append(failure)
    taken = dict.fromkeys(kinds, 0)
    for _ in range(min(most, len(failures))):
        fewest = min(
            (what for what in kinds if taken[what] < len(kinds[what])), key=taken.__getitem__
        )
        taken[fewest] += 1
    return [
        own[i * len(own) // taken[what]] for what, own in kinds.items() for i in range(taken[what])
    ]


def failures_figure(
    evaluation: PairEvaluation, failures: list[dict[str, Any]], store: Store
) -> Figure:
    """Of each pair both depths, and both frames laid together as found and as they are.

    Seen from above, the query grey; empty where there is no transform, or no truth.
    """
    figure = new_figure(10.0, 2.5 * len(failures))
    rows = np.array(figure.subfigures(len(failures), 1, squeeze=False)).ravel()
    for row, failure in zip(rows, failures, strict=True):
        row.suptitle(_headed(failure), x=0.01, ha="left", fontsize=8, parse_math=False)
        pictures = _pictures(evaluation, evaluation.tried[failure["number"]], store)
        line = row.subplots(1, len(pictures))
        for cell, (name, picture) in zip(line, pictures.items(), strict=True):
            cell.set(xticks=[], yticks=[])
            cell.set_xlabel(name, fontsize=8)
            cell.spines[:].set(color=_colour(failure["what"]), linewidth=2)
            if picture is not None:
                cell.imshow(picture)
            else:
                why = "no transform" if name == "as found" else "they are of two scenes"
                cell.text(0.5, 0.5, why, ha="center", va="center", fontsize=8)
    return figure


def _headed(failure: dict[str, Any]) -> str:
    off = failure["translation_m"]
    how_far = "nothing to compare with" if off is None else f"{off:.2f} m off"
    return (
        f"{failure['what'].replace('_', ' ')}: {failure['query']} to {failure['match']}\n"
        f"overlap {failure['true_overlap']:.2f}, {how_far}: {failure['reason']}"
    )


def _pictures(evaluation: PairEvaluation, one: Tried, store: Store) -> dict[str, Bytes | None]:
    query, match = (evaluation.members[i] for i in (one.drawn.query, one.drawn.match))
    frames = store.frame(query), store.frame(match)
    true = inverse(match.pose) @ query.pose if one.pair.same_scene else None
    found = one.pair.validation.T_match_query
    return {
        "query": depth_colours(frames[0]),
        "match": depth_colours(frames[1]),
        "as found": None if found is None else _together(one, frames, found),
        "as it is": None if true is None else _together(one, frames, true),
    }


def _together(one: Tried, frames: tuple[AnyFrame, AnyFrame], T: Floats) -> Bytes | None:
    """Both frames from above, the query laid on the match by a transform."""
    query, match = frames
    if isinstance(query, Frame) and isinstance(match, Frame):
        laid = replace(one.pair, validation=replace(one.pair.validation, T_match_query=T))
        cloud = merged(query, [laid], lambda _: match)
        turned = turns()["from above"] @ levelling(cloud.normals)
    else:
        its = moved(inverse(T), _points(match))
        cloud = _unshaded(_points(query), its)
        turned = np.diag([1.0, -1.0, -1.0])  # scanners stand upright, z up
    return rendered(cloud, turned, cloud.points) if len(cloud.points) else None


def _points(frame: AnyFrame) -> Floats:
    """Some of its points, (N, 3) metres, in the frame's own axes."""
    every = (
        frame.points.astype(np.float64)
        if isinstance(frame, Cloud)
        else points_of(frame, 1e-3, np.inf)
    )
    return every[:: max(-(-len(every) // POINTS), 1)].astype(np.float64)


def _unshaded(query: Floats, match: Floats) -> Merged:
    points = np.concatenate([query, match])
    of = np.repeat([0, 1], [len(query), len(match)])
    return Merged(points, np.zeros_like(points), of, 1)


def _colour(what: str) -> str:
    return {"wrongly_accepted": WRONG, "not_believed": RIGHT}.get(what, UNDECIDED)
