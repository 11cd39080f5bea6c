"""What diversification brings: the paper's two figures.

Outcome, ...  --diversity-->  translations and covered voxels of R, DR, VR, VDR
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.rigid import moved
from sceneprint.lab.evaluation.protocol import VIEWS, QueryOutcome, ValidatedPair
from sceneprint.types import AnyFrame, Cloud, Floats

#: Edge of a voxel, metres; depth from which surface is not counted; every so manieth pixel.
VOXEL, FARTHEST, PIXELS = 0.02, 4.0, 2

Voxels = NDArray[np.int64]


def diversity(
    outcomes: Sequence[QueryOutcome], poses: Sequence[Floats], database: Callable[[int], AnyFrame]
) -> dict[str, Any]:
    """How far the first five lie from the query and from each other, and what they cover.

    `translation` has, for each of R, DR, VR and VDR, the mean and the standard deviation (within
    the five) of the distance between the query and the match, metres, by true poses, averaged
    over queries. `coverage` has the 2 cm voxels that the first validated views see (true
    poses, depth below 4 m), for VR and VDR, in the mean over queries. VR and VDR are compared
    at equal numbers of views, on queries for which both have two or more; without any, null.

    Parameters
    ----------
    outcomes : see Outcome
    poses : (4, 4) of each database frame
    database : gives the frame of a database index, with its pose
    """
    compared = [(o, *equal_views(o)) for o in outcomes]
    compared = [row for row in compared if len(row[1]) >= 2]
    ranked = [(o, _of_scene(o, "R"), _of_scene(o, "DR")) for o in outcomes]
    ranked = [row for row in ranked if min(len(row[1]), len(row[2])) >= 2]
    translation = {
        "R": _translation([(o, r) for o, r, _ in ranked], poses),
        "DR": _translation([(o, d) for o, _, d in ranked], poses),
        "VR": _translation([(o, r) for o, r, _ in compared], poses),
        "VDR": _translation([(o, d) for o, _, d in compared], poses),
    }
    covered = coverage(outcomes, database)
    # where all that a query's views see lies beyond FARTHEST there is nothing to compare
    both = [pair for pair in covered if pair is not None and pair[0] > 0]
    ranked_mean, diverse_mean = np.mean(both, axis=0).tolist() if both else (0.0, 0.0)
    return {
        "queries": len(ranked),
        "queries_validated": len(compared),
        "translation": translation,
        "coverage": {
            "VR": ranked_mean if both else None,
            "VDR": diverse_mean if both else None,
            "ratio_of_means": diverse_mean / ranked_mean if both else None,
            "mean_ratio": float(np.mean([d / r for r, d in both])) if both else None,
        },
    }


def equal_views(outcome: QueryOutcome) -> tuple[list[ValidatedPair], list[ValidatedPair]]:
    """The first validated views of VR and VDR in the query's scene, as many of either."""
    ranked, diverse = (_of_scene(outcome, of) for of in ("VR", "VDR"))
    n = min(len(ranked), len(diverse))
    return ranked[:n], diverse[:n]


def coverage(
    outcomes: Sequence[QueryOutcome], database: Callable[[int], AnyFrame]
) -> list[tuple[int, int] | None]:
    """Voxels covered by VR's and VDR's views of each query; None with fewer than two views."""

    @lru_cache(256)
    def seen(match: int) -> Voxels:
        return voxels(database(match))

    def count(views: list[ValidatedPair]) -> int:
        return len(np.unique(np.concatenate([seen(pair.match) for pair in views])))

    result: list[tuple[int, int] | None] = []
    for outcome in outcomes:
        ranked, diverse = equal_views(outcome)
        result.append((count(ranked), count(diverse)) if len(ranked) >= 2 else None)
    return result


def voxels(frame: AnyFrame) -> Voxels:
    """The voxels that a frame sees, each once, as numbers that are the same for all frames."""
    points = points_of(frame, PIXELS, FARTHEST)
    if frame.pose is None:
        raise ValueError(f"{frame.name} has no pose")
    cells = np.floor(moved(frame.pose, points) / VOXEL).astype(np.int64)
    # 21 bits for each axis: 20 km either way
    half = 1 << 20
    x, y, z = (cells + half).T
    return np.unique((x << 42) | (y << 21) | z)


def points_of(frame: AnyFrame, step: int, farthest: float) -> Floats:
    """(N, 3) metres, sensor frame: every `step`-th pixel both ways that is nearer than that.

    Of a cloud all points that are nearer than that to the sensor.
    """
    if isinstance(frame, Cloud):
        every: Floats = frame.points.astype(float)
        near: Floats = every[np.linalg.norm(every, axis=1) < farthest]
        return near
    k = frame.intrinsics
    y, x = np.mgrid[0 : k.height : step, 0 : k.width : step]
    z = frame.depth[::step, ::step].astype(float)
    points: Floats = np.stack([(x - k.cx) / k.fx * z, (y - k.cy) / k.fy * z, z], axis=-1)
    return points[(z > 0) & (z < farthest)]


def _of_scene(outcome: QueryOutcome, of: str) -> list[ValidatedPair]:
    """The first five, less those of other scenes: they lie nowhere in this one."""
    return [pair for pair in outcome.views(of)[:VIEWS] if pair.same_scene]


def _translation(
    rows: Sequence[tuple[QueryOutcome, list[ValidatedPair]]], poses: Sequence[Floats]
) -> dict[str, float | None]:
    if not rows:
        return {"mean_m": None, "std_m": None}
    each = [
        np.array([np.linalg.norm(poses[p.match][:3, 3] - o.pose[:3, 3]) for p in views])
        for o, views in rows
    ]
    return {
        "mean_m": float(np.mean([d.mean() for d in each])),
        "std_m": float(np.mean([d.std() for d in each])),
    }
