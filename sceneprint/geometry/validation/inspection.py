"""Sec. III-E, to look at: what a validation's figures were counted on, point by point.

    Geometry, Geometry, T  --trace-->  Traces: corresponding patches, inliers, violations
    points, Surface, T  --judged-->  which agree, which violate free space
    points, Surface, T  --residuals-->  and how far those that agree are from the surface

Nothing here decides: the points are judged by `overlap.py`, one at a time.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.kernel import kernel
from sceneprint.geometry.registration.alignment import ConsensusParameters
from sceneprint.geometry.registration.overlap import (
    OverlapParameters,
    overlap_target,
    sample_points,
    tolerances,
    weigh_overlap,
)
from sceneprint.geometry.rigid import inverse, transform_points
from sceneprint.types import Bytes, Floats, Floats32, Geometry, Ints32, Patches, Surface

#: What becomes of a point: nothing to compare it with, or beside the surface; on it; before it.
NEITHER, AGREES, VIOLATES = 0, 1, 2
#: And how far it is from the surface, as `sceneprint.formats.export` tells it.
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
        inliers, violations = weigh_overlap(
            source[i : i + 1], one, points, normals, camera, heads, chain, T, numbers
        )
        if inliers > 0:
            out[i] = 1
        elif violations > 0:
            out[i] = 2


def judged(
    source: Floats32, target: Surface, T_target_source: Floats, p: OverlapParameters
) -> Verdicts:
    """What becomes of each of a source's points (N, 6): (N,) NEITHER, AGREES or VIOLATES."""
    out = np.zeros(len(source), np.uint8)
    t = overlap_target(target, p)
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
        inliers, violations = weigh_overlap(
            source[i : i + 1], one, points, normals, camera, heads, chain, T, numbers
        )
        if inliers == 0:
            out[i] = VIOLATION if violations > 0 else OUTSIDE
            continue
        below, least = 0, TOLERANCE
        while least - below > 1:
            step = (below + least) // 2
            narrower[0] = numbers[0] * step / TOLERANCE
            inliers, _ = weigh_overlap(
                source[i : i + 1], one, points, normals, camera, heads, chain, T, narrower
            )
            if inliers > 0:
                least = step
            else:
                below = step
        out[i] = least


def residuals(
    source: Floats32, target: Surface, T_target_source: Floats, p: OverlapParameters
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
    t = overlap_target(target, p)
    _measure(
        source, t.points, t.normals, t.camera, t.heads, t.chain,
        np.ascontiguousarray(T_target_source), tolerances(p), out,
    )  # fmt: skip
    return out


def trace(
    query: Geometry, match: Geometry, T_match_query: Floats,
    p: OverlapParameters | None = None, patches_p: ConsensusParameters | None = None,
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
    p = p or OverlapParameters()
    of_query, of_match = (
        sample_points(query.surface, p.stride),
        sample_points(match.surface, p.stride),
    )
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
    apart = np.linalg.norm(transform_points(T, query.means)[:, None] - match.means, axis=2)
    cosines = (query.normals @ T[:3, :3].T) @ match.normals.T
    apart = np.where(cosines > p.inlier_cosine, apart, np.inf)
    there, back = apart.argmin(axis=1), apart.argmin(axis=0)
    one = np.flatnonzero(back[there] == np.arange(len(query)))
    one = one[apart[one, there[one]] < p.inlier_distance]
    distances = apart[one, there[one]]
    order = np.argsort(distances, kind="stable")
    pairs = np.stack([one, there[one]], axis=1)[order].astype(np.int32)
    return pairs, distances[order]


# Two frames laid on each other, to see how well they fit.
#
# Surface, Surface, T  --overlay-->  points, normals, colours, in the target's frame

Colour = Literal["source", "normal", "residual"]

#: Of the source's points, and of the target's.
SOURCE, TARGET = (217, 119, 43), (43, 108, 176)
#: Distances from the other's surface, of `TOLERANCE` of what validation allows, and the colours of
#: the points that keep them; then of those that lie beside it or where it did not look, and of
#: violations.
STEPS = (50, 100, TOLERANCE)
STEP_COLOURS = np.array(
    [(38, 130, 60), (140, 190, 70), (240, 200, 60), (150, 155, 160), (200, 40, 40)], np.uint8
)


def overlay(
    source: Surface, target: Surface, T_target_source: Floats, colour: Colour = "source",
    p: OverlapParameters | None = None,
) -> tuple[Floats, Floats, Bytes]:  # fmt: skip
    """Both surfaces as one coloured cloud, the source's points first.

    Parameters
    ----------
    source, target : every valid pixel of both
    T_target_source : (4, 4)
    colour : "source" tells the frames apart, "normal" the directions of the surfaces (x, y, z in
        the target's frame from -1 to 1 as red, green, blue from 0 to 255), "residual" how far a
        point is from the other's surface (`STEPS`)
    p : when points agree and when they violate free space

    Returns
    -------
    points, normals : (N, 3), in the target's frame
    colours : (N, 3)
    """
    T = T_target_source
    ours, theirs = sample_points(source, 1), sample_points(target, 1)
    points = np.concatenate(
        [transform_points(T, ours[:, :3].astype(float)), theirs[:, :3].astype(float)]
    )
    turned = ours[:, 3:].astype(float) @ T[:3, :3].T
    normals = np.concatenate([turned, theirs[:, 3:].astype(float)])
    if colour == "normal":
        shade = np.clip(np.rint((normals + 1.0) * 127.5), 0, 255)
        return points, normals, shade.astype(np.uint8)
    if colour == "source":
        of = np.repeat(np.array([SOURCE, TARGET], np.uint8), [len(ours), len(theirs)], axis=0)
        return points, normals, of
    p = p or OverlapParameters()
    steps: NDArray[np.intp] = np.searchsorted(
        (*STEPS, OUTSIDE),
        np.concatenate([residuals(ours, target, T, p), residuals(theirs, source, inverse(T), p)]),
    )
    return points, normals, STEP_COLOURS[steps]


# Sec. III-F backwards: which patch a point of a surface lies on, for who has the patches alone.
#
# points, normals, Patches  --patches_at-->  (N,) indices
#
# Artifacts do not keep which point went into which patch. Of patches of about one size, as those of
# validation are, the nearest mean with a like normal is nearly it.

#: Least cosine between the normals of a point and of its patch.
_COSINE = 0.5
#: A point lies at most so many radii of a patch (of a disc of its area) from its mean.
_RADII = 4.0


@kernel
def _nearest(
    points: Floats32, means: Floats, normals: Floats, reaches: Floats, least: float, out: Ints32
) -> None:
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        nx, ny, nz = points[i, 3], points[i, 4], points[i, 5]
        nearest = np.inf
        for j in range(len(means)):
            dx, dy, dz = x - means[j, 0], y - means[j, 1], z - means[j, 2]
            square = dx * dx + dy * dy + dz * dz
            if square >= nearest or square > reaches[j] * reaches[j]:
                continue
            if nx * normals[j, 0] + ny * normals[j, 1] + nz * normals[j, 2] > least:
                nearest = square
                out[i] = j


def patches_at(points: Floats32, patches: Patches) -> Ints32:
    """The patch that each point lies on.

    Parameters
    ----------
    points : (N, 6) float32 of `sampled`, points and normals
    patches : of the same surface

    Returns
    -------
    (N,) the nearest of the patches with a like normal; -1 where none is within reach
    """
    found = np.full(len(points), -1, np.int32)
    reaches = _RADII * np.sqrt(patches.areas / np.pi)
    _nearest(points, patches.means, patches.normals, reaches, _COSINE, found)
    return found
