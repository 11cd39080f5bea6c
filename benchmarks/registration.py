"""Two frames to a transform: our validation beside Open3D's FPFH + RANSAC + ICP.

FramePair of `benchmarks.pairs`  --measure-->  RegistrationFigures

Ours works in both directions, tells whether to believe the result, and looks for rivals; Open3D's
works in one direction and always answers. Features are counted on both frames, for both.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from tqdm import tqdm

from benchmarks.encode import Clock, points_of
from benchmarks.pairs import FramePair
from sceneprint.errors import MissingDependency
from sceneprint.fusion import open3d
from sceneprint.geometry.rigid import difference
from sceneprint.models import Model
from sceneprint.pipeline import geometry_of, validate
from sceneprint.signing import see
from sceneprint.types import DepthFrame, Floats
from sceneprint_lab.evaluation.pair_run import METHODS, register

#: The one of Open3D's methods that is timed here; `sceneprint evaluate-pairs` has the others.
METHOD = METHODS[0]
#: A transform is right within this, metres and radians.
RIGHT = (0.10, float(np.radians(10.0)))


@dataclass(frozen=True)
class RegistrationFigures:
    """Medians over all pairs, milliseconds; shares are medians of each pair's own.

    `share` compares all of ours with all of Open3D's; `share_of_stored` validation alone, as of
    frames whose geometry is stored, with all of Open3D's. `right` and `open3d_right`: share of
    pairs within 10 cm and 10 degrees of the truth, ours only where accepted.
    """

    pairs: int
    mean_overlap: float
    stages: dict[str, float]
    ours: float
    right: float
    open3d_stages: dict[str, float]
    open3d: float | None
    open3d_right: float | None
    share: float | None
    share_of_stored: float | None
    note: str


def register_by_us(
    query: DepthFrame, match: DepthFrame, model: Model, clock: Clock
) -> Floats | None:
    """Validation of two frames: T_match_query (4, 4) where it is accepted, else None."""
    of_query, of_match = clock.run(
        "geometry of both frames",
        lambda: [geometry_of(see(frame, model.parameters), model) for frame in (query, match)],
    )
    found = clock.run("validation", lambda: validate(of_query, of_match, seed=0))
    return found.T_match_query if found.status == "accepted" else None


def is_right(T_match_query: Floats | None, truth: Floats) -> bool:
    """Within 10 cm and 10 degrees of the truth."""
    if T_match_query is None:
        return False
    metres, radians = difference(T_match_query, truth)
    return metres <= RIGHT[0] and radians <= RIGHT[1]


def measure(pairs: Sequence[FramePair], model: Model, warm_up: int = 1) -> RegistrationFigures:
    """Validate every pair and, in turn, register it by Open3D, on the processor we are pinned to.

    Parameters
    ----------
    pairs : at least one
    model : with the parameters of our validation
    warm_up : pairs that are also done before the clock runs
    """
    p, note, o3d = model.parameters.depth, "", None
    try:
        o3d = open3d("FPFH")
    except MissingDependency as error:
        note = str(error)
    for pair in pairs[:warm_up]:
        register_by_us(pair.query, pair.match, model, Clock())
    ours: list[dict[str, float]] = []
    theirs: list[dict[str, float]] = []
    right: list[bool] = []
    open3d_right: list[bool] = []
    for pair in tqdm(pairs, desc="registration", unit="pair", disable=None):
        clock = Clock()
        found = register_by_us(pair.query, pair.match, model, clock)
        ours.append(clock.stages)
        right.append(is_right(found, pair.T_match_query))
        if o3d is not None:
            clouds = [
                points_of(frame, p.minimum_depth, p.maximum_depth)
                for frame in (pair.query, pair.match)
            ]
            attempt = register(clouds[0], clouds[1], o3d, [METHOD])[METHOD]
            theirs.append(attempt.stages)
            open3d_right.append(is_right(attempt.refined, pair.T_match_query))
    sums, other = [sum(row.values()) for row in ours], [sum(row.values()) for row in theirs]
    alone = [row["validation"] for row in ours]
    return RegistrationFigures(
        pairs=len(pairs),
        mean_overlap=float(np.mean([pair.overlap for pair in pairs])),
        stages=_medians(ours),
        ours=float(np.median(sums)),
        right=float(np.mean(right)),
        open3d_stages=_medians(theirs),
        open3d=_median(other),
        open3d_right=float(np.mean(open3d_right)) if open3d_right else None,
        share=_median(a / b for a, b in zip(sums, other, strict=False)),
        share_of_stored=_median(a / b for a, b in zip(alone, other, strict=False)),
        note=note,
    )


def table(f: RegistrationFigures) -> list[str]:
    """The figures as lines of Markdown."""
    lines = [
        f"### Registration: median of {f.pairs} pairs of frames (mean overlap "
        f"{f.mean_overlap:.2f}), one thread, warm",
        "",
        "| stage | ms |",
        "|---|--:|",
        *(f"| {stage} | {ms:.1f} |" for stage, ms in f.stages.items()),
        f"| **ours, sum** | **{f.ours:.1f}** |",
        *(f"| Open3D {stage} | {ms:.1f} |" for stage, ms in f.open3d_stages.items()),
    ]
    if f.open3d is None or f.share is None or f.share_of_stored is None:
        lines += [f"| Open3D | not measured: {f.note} |"]
    else:
        lines += [
            f"| **Open3D, sum** | **{f.open3d:.1f}** |",
            f"| **ours / Open3D** | **{f.share:.3f}** |",
            f"| validation of stored frames / Open3D | {f.share_of_stored:.3f} |",
        ]
    right = f"Accepted and within 10 cm and 10 degrees of the truth: {f.right:.2f} of the pairs"
    theirs = "" if f.open3d_right is None else f"; Open3D's within it: {f.open3d_right:.2f}"
    return [*lines, "", f"{right}{theirs}.", ""]


def _median(values: Iterable[float]) -> float | None:
    listed = list(values)
    return float(np.median(listed)) if listed else None


def _medians(rows: list[dict[str, float]]) -> dict[str, float]:
    return {s: float(np.median([row[s] for row in rows])) for s in rows[0]} if rows else {}
