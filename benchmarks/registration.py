"""Measure the validation of two frames, and Open3D's FPFH + RANSAC + ICP.

Our validation works in both directions, accepts or rejects the result, and searches for rivals.
Open3D works in one direction and never rejects. Both timings include the features of both frames.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from tqdm import tqdm

from benchmarks.encode import open3d_or_note, stage_rows
from benchmarks.pairs import FramePair
from sceneprint.geometry.rigid import pose_difference
from sceneprint.models import Model
from sceneprint.pipeline import geometry_of, validate
from sceneprint.signing import see
from sceneprint.types import DepthFrame, Floats
from sceneprint_lab.evaluation.pair_run import METHODS, Clock, points_of, register

#: The timed method of Open3D; `sceneprint evaluate-pairs` measures the others.
METHOD = METHODS[0]
#: Maximum errors of a correct transform, metres and radians.
RIGHT = (0.10, float(np.radians(10.0)))


def register_by_us(
    query: DepthFrame, match: DepthFrame, model: Model, clock: Clock
) -> Floats | None:
    """Validate two frames; return T_match_query (4, 4) of an accepted match, else None."""
    of_query, of_match = clock.run(
        "geometry of both frames",
        lambda: [geometry_of(see(frame, model.parameters), model) for frame in (query, match)],
    )
    result = clock.run("validation", lambda: validate(of_query, of_match, seed=0))
    return result.T_match_query if result.status == "accepted" else None


def is_right(T_match_query: Floats | None, truth: Floats) -> bool:
    """Return whether a transform is within 10 cm and 10 degrees of the truth."""
    if T_match_query is None:
        return False
    metres, radians = pose_difference(T_match_query, truth)
    return metres <= RIGHT[0] and radians <= RIGHT[1]


def measure(pairs: Sequence[FramePair], model: Model, warm_up: int = 1) -> list[str]:
    """Alternately validate pairs and register them with Open3D; return the table.

    Parameters
    ----------
    pairs : at least one pair
    warm_up : number of pairs that are validated first without timing
    """
    p, (o3d, note) = model.parameters.depth, open3d_or_note()
    for pair in pairs[:warm_up]:
        register_by_us(pair.query, pair.match, model, Clock())
    ours: list[dict[str, float]] = []
    theirs: list[dict[str, float]] = []
    right: list[bool] = []
    open3d_right: list[bool] = []
    for pair in tqdm(pairs, desc="registration", unit="pair", disable=None):
        clock = Clock()
        transform = register_by_us(pair.query, pair.match, model, clock)
        ours.append(clock.stages)
        right.append(is_right(transform, pair.T_match_query))
        if o3d is not None:
            clouds = [
                points_of(frame, p.minimum_depth, p.maximum_depth)
                for frame in (pair.query, pair.match)
            ]
            attempt = register(clouds[0], clouds[1], o3d, [METHOD])[METHOD]
            theirs.append(attempt.stages)
            open3d_right.append(is_right(attempt.refined, pair.T_match_query))
    sums, other = [sum(row.values()) for row in ours], [sum(row.values()) for row in theirs]
    stored = [row["validation"] for row in ours]
    lines = [
        f"### Registration: median of {len(pairs)} pairs of frames (mean overlap "
        f"{np.mean([pair.overlap for pair in pairs]):.2f}), one thread, warm",
        "", "| stage | ms |", "|---|--:|", *stage_rows(ours),
        f"| **ours, sum** | **{np.median(sums):.1f}** |", *stage_rows(theirs, "Open3D "),
    ]  # fmt: skip
    text = (
        f"Accepted and within 10 cm and 10 degrees of the truth: {np.mean(right):.2f} of the pairs"
    )
    if other:
        text += f"; Open3D's within it: {np.mean(open3d_right):.2f}"
        lines += [
            f"| **Open3D, sum** | **{np.median(other):.1f}** |",
            f"| **ours / Open3D** | **{np.median(np.divide(sums, other)):.3f}** |",
            f"| validation of stored frames / Open3D | {np.median(np.divide(stored, other)):.3f} |",
        ]
    else:
        lines.append(f"| Open3D | not measured: {note} |")
    return [*lines, "", f"{text}.", ""]
