"""Sec. III-E, to look at: what a validation's figures were counted on, point by point.

    Geometry, Geometry, T  --trace-->  Traces: corresponding patches, inliers, violations
    points, Surface, T  --judged-->  which agree, which violate free space
    points, Surface, T  --residuals-->  and how far those that agree are from the surface

Nothing here decides: the points are judged by `agreement.py`, one at a time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.agreement import (
    AgreementParameters,
    looked_up,
    sampled,
    tolerances,
    weigh_agreement,
)
from sceneprint.geometry.consensus import ConsensusParameters
from sceneprint.geometry.kernel import kernel
from sceneprint.geometry.rigid import inverse, moved
from sceneprint.types import Floats, Floats32, Geometry, Ints32, Patches, Surface

#: What becomes of a point: nothing to compare it with, or beside the surface; on it; before it.
NEITHER, AGREES, VIOLATES = 0, 1, 2
#: And how far it is from the surface, as `sceneprint.points` tells it.
TOLERANCE, OUTSIDE, VIOLATION = 250, 253, 254

Verdicts = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Traces:
    """What two frames have to do with each other under one transform.

    Parameters
    ----------
    pairs : (M, 2) indices of a patch of the query and the patch of the match it coincides with
    distances : (M,) between their means, metres
    query, match : (N, 6) points and normals, each in its own frame, that evidence is counted on
    of_query, of_match : (N,) NEITHER, AGREES or VIOLATES
    """

    pairs: Ints32
    distances: Floats
    query: Floats32
    match: Floats32
    of_query: Verdicts
    of_match: Verdicts


@kernel
def _judge(
    source: Floats32, points: Floats32, normals: Floats32, camera: Floats,
    heads: Ints32, chain: Ints32, T: Floats, numbers: Floats, out: Verdicts,
) -> None:  # fmt: skip
    one = np.ones(1, np.float32)
    for i in range(len(source)):
        inliers, violations = weigh_agreement(
            source[i : i + 1], one, points, normals, camera, heads, chain, T, numbers
        )
        if inliers > 0:
            out[i] = 1
        elif violations > 0:
            out[i] = 2


def judged(
    source: Floats32, target: Surface, T_target_source: Floats, p: AgreementParameters
) -> Verdicts:
    """What becomes of each of a source's points (N, 6): (N,) NEITHER, AGREES or VIOLATES."""
    out = np.zeros(len(source), np.uint8)
    t = looked_up(target, p)
    _judge(
        source, t.points, t.normals, t.camera, t.heads, t.chain,
        np.ascontiguousarray(T_target_source), tolerances(p), out,
    )  # fmt: skip
    return out


@kernel
def _measure(
    source: Floats32, points: Floats32, normals: Floats32, camera: Floats,
    heads: Ints32, chain: Ints32, T: Floats, numbers: Floats, out: Verdicts,
) -> None:  # fmt: skip
    one, narrower = np.ones(1, np.float32), numbers.copy()
    for i in range(len(source)):
        inliers, violations = weigh_agreement(
            source[i : i + 1], one, points, normals, camera, heads, chain, T, numbers
        )
        if inliers == 0:
            out[i] = VIOLATION if violations > 0 else OUTSIDE
            continue
        below, least = 0, TOLERANCE
        while least - below > 1:
            step = (below + least) // 2
            narrower[0] = numbers[0] * step / TOLERANCE
            inliers, _ = weigh_agreement(
                source[i : i + 1], one, points, normals, camera, heads, chain, T, narrower
            )
            if inliers > 0:
                least = step
            else:
                below = step
        out[i] = least


def residuals(
    source: Floats32, target: Surface, T_target_source: Floats, p: AgreementParameters
) -> Verdicts:
    """How far each of a source's points is from the target's surface, in steps of what agrees.

    Parameters
    ----------
    source, target, T_target_source, p : see `agreements`

    Returns
    -------
    (N,) the least k of 1 to TOLERANCE such that it agrees within k / TOLERANCE of
    `surface_tolerance`, which grows with distance; VIOLATION where it violates free space, OUTSIDE
    where it does neither: it is seen by no pixel, or lies beside or behind the surface
    """
    out = np.zeros(len(source), np.uint8)
    t = looked_up(target, p)
    _measure(
        source, t.points, t.normals, t.camera, t.heads, t.chain,
        np.ascontiguousarray(T_target_source), tolerances(p), out,
    )  # fmt: skip
    return out


def trace(
    query: Geometry, match: Geometry, T_match_query: Floats,
    p: AgreementParameters | None = None, patches_p: ConsensusParameters | None = None,
) -> Traces:  # fmt: skip
    """What the figures of a validation were counted on: Sec. III-E.

    Parameters
    ----------
    query, match : geometry artifacts
    T_match_query : (4, 4)
    p : that it was validated with
    patches_p : when patches coincide, as correspondences do

    Returns
    -------
    traces : AGREES counts as often as `Validation.inliers` says
    """
    p = p or AgreementParameters()
    of_query, of_match = sampled(query.surface, p.stride), sampled(match.surface, p.stride)
    pairs, distances = _coincident(
        query.patches, match.patches, T_match_query, patches_p or ConsensusParameters()
    )
    return Traces(
        pairs, distances, of_query, of_match,
        judged(of_query, match.surface, T_match_query, p),
        judged(of_match, query.surface, inverse(T_match_query), p),
    )  # fmt: skip


def _coincident(
    query: Patches, match: Patches, T: Floats, p: ConsensusParameters
) -> tuple[Ints32, Floats]:
    """Patches that are each other's nearest with a like normal, by distance."""
    if not len(query) or not len(match):
        return np.zeros((0, 2), np.int32), np.zeros(0)
    apart = np.linalg.norm(moved(T, query.means)[:, None] - match.means, axis=2)
    cosines = (query.normals @ T[:3, :3].T) @ match.normals.T
    apart = np.where(cosines > p.inlier_cosine, apart, np.inf)
    there, back = apart.argmin(axis=1), apart.argmin(axis=0)
    one = np.flatnonzero(back[there] == np.arange(len(query)))
    one = one[apart[one, there[one]] < p.inlier_distance]
    distances = apart[one, there[one]]
    order = np.argsort(distances, kind="stable")
    pairs = np.stack([one, there[one]], axis=1)[order].astype(np.int32)
    return pairs, distances[order]
