"""Evidence for a validation, point by point, for display (Sec. III-E).

    Geometry, Geometry, T  --trace-->  Traces: corresponding patches, inliers, violations
    points, Surface, T  --point_verdicts-->  agreements and violations of free space
    points, Surface, T  --residuals-->  distances of agreeing points from the surface
    Surface, Surface, T  --overlay-->  points, normals, colours in the target's frame
    points, normals, Patches  --patches_at-->  (N,) indices

The verdicts on points come from `overlap.py`.
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

#: Verdicts on a point: unobserved, or beside or behind the surface; on it; in free space.
NEITHER, AGREES, VIOLATES = 0, 1, 2
#: Maximum residual, and codes of verdicts, in the encoding of `sceneprint.formats.export`.
TOLERANCE, OUTSIDE, VIOLATION = 250, 253, 254

Verdicts = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Traces:
    """Corresponding patches and verdicts on points of two frames under a transform.

    Parameters
    ----------
    pairs : (M, 2) indices of coinciding patches of the query and of the match
    distances : (M,) distances between the means of these patches, metres
    query, match : (N, 6) points and normals of each frame, in its own coordinates
    of_query, of_match : (N,) NEITHER, AGREES or VIOLATES
    """

    pairs: Ints32
    distances: Floats
    query: Floats32
    match: Floats32
    of_query: Verdicts
    of_match: Verdicts


@kernel
def _write_verdicts(
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


def point_verdicts(
    source: Floats32, target: Surface, T_target_source: Floats, p: OverlapParameters
) -> Verdicts:
    """Return the verdict on each source point (N, 6): NEITHER, AGREES or VIOLATES, (N,)."""
    out = np.zeros(len(source), np.uint8)
    t = overlap_target(target, p)
    _write_verdicts(
        source, *t, np.ascontiguousarray(T_target_source), tolerances(p), out,
    )  # fmt: skip
    return out


@kernel
def _write_residuals(
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
    """Return the distance of each source point from the target's surface, in steps.

    Parameters
    ----------
    source, target, T_target_source, p : arguments of `agreements`

    Returns
    -------
    (N,) smallest k from 1 to TOLERANCE such that the point agrees within k / TOLERANCE times
    `surface_tolerance`, which grows with distance; VIOLATION if the point violates free space;
    OUTSIDE if no pixel sees the point, or if it lies beside or behind the surface
    """
    out = np.zeros(len(source), np.uint8)
    t = overlap_target(target, p)
    _write_residuals(
        source, *t, np.ascontiguousarray(T_target_source), tolerances(p), out,
    )  # fmt: skip
    return out


def trace(
    query: Geometry, match: Geometry, T_match_query: Floats,
    p: OverlapParameters | None = None, patches_p: ConsensusParameters | None = None,
) -> Traces:  # fmt: skip
    """Return the points and patches that a validation counts, with verdicts: Sec. III-E.

    Parameters
    ----------
    query, match : geometry artifacts
    T_match_query : (4, 4) transform of the validation
    p : parameters of the validation
    patches_p : limits within which patches coincide
    """
    p = p or OverlapParameters()
    ours, theirs = (sample_points(frame.surface, p.stride) for frame in (query, match))
    pairs, distances = _coincident_patches(
        query.patches, match.patches, T_match_query, patches_p or ConsensusParameters()
    )
    return Traces(
        pairs, distances, ours, theirs,
        point_verdicts(ours, match.surface, T_match_query, p),
        point_verdicts(theirs, query.surface, inverse(T_match_query), p),
    )  # fmt: skip


def _coincident_patches(
    query: Patches, match: Patches, T: Floats, p: ConsensusParameters
) -> tuple[Ints32, Floats]:
    """Return pairs of mutually nearest patches with similar normals, and distances, ascending."""
    if not len(query) or not len(match):
        return np.zeros((0, 2), np.int32), np.zeros(0)
    apart = np.linalg.norm(transform_points(T, query.means)[:, None] - match.means, axis=2)
    cosines = (query.normals @ T[:3, :3].T) @ match.normals.T
    apart = np.where(cosines > p.inlier_cosine, apart, np.inf)
    there, back = apart.argmin(axis=1), apart.argmin(axis=0)
    mutual = np.flatnonzero(back[there] == np.arange(len(query)))
    mutual = mutual[apart[mutual, there[mutual]] < p.inlier_distance]
    distances = apart[mutual, there[mutual]]
    order = np.argsort(distances, kind="stable")
    pairs = np.stack([mutual, there[mutual]], axis=1)[order].astype(np.int32)
    return pairs, distances[order]


Colour = Literal["source", "normal", "residual"]

#: Colours of the source's points and of the target's points.
SOURCE, TARGET = (217, 119, 43), (43, 108, 176)
#: Upper limits of residuals, and the colours of points within each limit, of OUTSIDE points and of
#: violations.
STEPS = (50, 100, TOLERANCE)
STEP_COLOURS = np.array(
    [(38, 130, 60), (140, 190, 70), (240, 200, 60), (150, 155, 160), (200, 40, 40)], np.uint8
)


def overlay(
    source: Surface, target: Surface, T_target_source: Floats, colour: Colour = "source",
    p: OverlapParameters | None = None,
) -> tuple[Floats, Floats, Bytes]:  # fmt: skip
    """Combine both surfaces into a coloured cloud; the source's points come first.

    Parameters
    ----------
    source, target : surfaces; all of their valid pixels are included
    T_target_source : (4, 4) transform that aligns the surfaces
    colour : "source" distinguishes the frames, "normal" shows normals (x, y, z in the target's
        frame from -1 to 1 as red, green, blue from 0 to 255), "residual" shows the distance from
        the other surface (`STEPS`)
    p : limits of agreement and of violations

    Returns
    -------
    points, normals : (N, 3) in the target's frame
    colours : (N, 3) uint8
    """
    T = T_target_source
    ours, theirs = sample_points(source, 1), sample_points(target, 1)
    points = np.concatenate(
        [transform_points(T, ours[:, :3].astype(float)), theirs[:, :3].astype(float)]
    )
    rotated = ours[:, 3:].astype(float) @ T[:3, :3].T
    normals = np.concatenate([rotated, theirs[:, 3:].astype(float)])
    if colour == "normal":
        shade = np.clip(np.rint((normals + 1.0) * 127.5), 0, 255)
        return points, normals, shade.astype(np.uint8)
    if colour == "source":
        pair = np.array([SOURCE, TARGET], np.uint8)
        return points, normals, np.repeat(pair, [len(ours), len(theirs)], axis=0)
    p = p or OverlapParameters()
    steps: NDArray[np.intp] = np.searchsorted(
        (*STEPS, OUTSIDE),
        np.concatenate([residuals(ours, target, T, p), residuals(theirs, source, inverse(T), p)]),
    )
    return points, normals, STEP_COLOURS[steps]


#: Minimum cosine between the normals of a point and of its patch.
_COSINE = 0.5
#: Maximum distance of a point from its patch's mean, in radii of a disc with the patch's area.
_RADII = 4.0


@kernel
def _assign_patches(
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
    """Return the nearest patch with a similar normal for each point, (N,); -1 if there is none.

    Artifacts do not store which patch a point belongs to. For patches of similar sizes, the results
    are nearly the original labels.

    Parameters
    ----------
    points : (N, 6) float32 result of `sample_points`
    patches : patches of the same surface
    """
    indices = np.full(len(points), -1, np.int32)
    reaches = _RADII * np.sqrt(patches.areas / np.pi)
    _assign_patches(points, patches.means, patches.normals, reaches, _COSINE, indices)
    return indices
