"""Sec. III-E, search: two frames to the transform that explains them best, and to others.

    Geometry, Geometry  --align-->  Alignment               of one direction alone
    Geometry, Geometry  --align_scans-->  two Alignments    of scans, from one search
    Geometry, Geometry, T  --align_guided-->  Alignment     without a search, from a known transform
    transforms, ups  --tilts-->  angles by which they lay the one up beside the other

The two directions of depth images are searched independently: that they meet is evidence, which
one search for both would take away. Scans see so much more that one search is enough; there the
directions are refined apart.

Gravity rules transforms out where both frames know which way is up. An IMU tells up in its sensor's
coordinates to half a degree or so. A transform of two frames of one place must then lay the up of
the one on that of the other: what tilts is not unlikely but impossible. That holds only as far as
`up` is right, so the search is told of it with room to spare, and where nothing fits with it, the
surfaces are asked once without it. Gravity is not the paper's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.execution import cached_per_frame
from sceneprint.geometry.registration.consensus import ConsensusParameters, consensus
from sceneprint.geometry.registration.icp import (
    COARSE,
    FINE,
    Refined,
    RefinementParameters,
    refine,
    refined_all,
    refined_with_index,
)
from sceneprint.geometry.registration.overlap import (
    OverlapParameters,
    PlaneParameters,
    PlaneView,
    agreements,
    explained,
    plane_view,
    sampled,
)
from sceneprint.geometry.registration.patch_descriptors import (
    MatchingParameters,
    SlopeGate,
    correspondences,
)
from sceneprint.geometry.registration.plan_search import (
    PlanParameters,
    ScanPlan,
    other_plans,
    plan_hypotheses,
    plan_of,
    up_of,
)
from sceneprint.geometry.registration.sequence_alignment import (
    Matching,
    SequenceParameters,
    sequence_correspondences,
)
from sceneprint.geometry.rigid import distinct, inverse, inverses
from sceneprint.geometry.surface.camera import kind_of
from sceneprint.types import Floats, Floats32, Geometry, Ints32, Sphere, Surface

# Gravity: the transforms that are left where both frames know which way is up.

#: Unit vectors (3,), up in the coordinates of source and target; None where it is not known.
Ups = tuple[Floats | None, Floats | None]
NO_UPS: Ups = (None, None)


@dataclass(frozen=True)
class GravityParameters:
    """How far transforms may tilt against `up`; the room is for its noise."""

    gate: float = math.radians(15.0)  #: of two patches that correspond, their angles to up
    proposed_tilt: float = math.radians(20.0)  #: most of a hypothesis that is yet to be refined
    refined_tilt: float = math.radians(10.0)  #: most of one that is refined: beyond, `up` is wrong
    rival_tilt: float = math.radians(20.0)  #: from which on a rival is impossible
    floor_tilt: float = math.radians(30.0)  #: within which of `up` a frame's floor is looked for
    floor_stride: int = 7  #: of the pixels that it is looked for among


def tilts(transforms: Floats, ups: Ups) -> Floats:
    """Angles between up carried over by each transform and up as the target has it: (n,) radians.

    Parameters
    ----------
    transforms : (n, 4, 4) T_target_source
    ups : of source and target; 0 for all where one is not known
    """
    source, target = ups
    if source is None or target is None:
        return np.zeros(len(transforms))
    carried = transforms[:, :3, :3] @ source
    across = np.linalg.norm(np.cross(carried, target), axis=1)
    angles: Floats = np.arctan2(across, carried @ target)  # exact near 0, as acos is not
    return angles


def tilt_of(T: Floats | None, ups: Ups) -> float | None:
    """By how much one transform tilts, radians; None where that cannot be said."""
    if T is None or ups[0] is None or ups[1] is None:
        return None
    return float(tilts(T[None], ups)[0])


def are_level(transforms: Floats, ups: Ups, most: float) -> NDArray[np.bool_]:
    """Which transforms tilt by no more than that: all of them where an up is not known."""
    level: NDArray[np.bool_] = tilts(transforms, ups) <= most
    return level


def slopes(normals: Floats, up: Floats) -> Floats:
    """Angles of normals (n, 3) to up: (n,) radians, 0 for floors and pi/2 for walls."""
    angles: Floats = np.arccos(np.clip(normals @ up, -1.0, 1.0))
    return angles


def floor_error(frame: Geometry, up: Floats, p: GravityParameters) -> float:
    """How far `up` lies from the direction near it that most of the frame's surface faces, radians.

    Floors, tables and what stands on them tell up as well as an IMU does, where they are in view.
    A floor that is not in view tells nothing, and a ramp the wrong thing: a hint, and no evidence.

    Parameters
    ----------
    frame : of which `up` (3,) was told
    p : see GravityParameters
    """
    facing = frame.surface.normals[frame.surface.valid][:: p.floor_stride].astype(float)
    if not len(facing):
        return 0.0
    cosine = float(np.clip(up_of(facing, up, p.floor_tilt) @ up, -1.0, 1.0))
    return math.acos(cosine)


def contradiction(
    tilt: float, query: Geometry, match: Geometry, ups: Ups, p: GravityParameters
) -> str:
    """What is said of surfaces that fit, but only tilted against `up`.

    Parameters
    ----------
    tilt : of the transform, radians
    query, match : the two frames
    ups : of query and match, both known
    p : see GravityParameters
    """
    wrong = [
        name
        for name, frame, up in (("query", query, ups[0]), ("match", match, ups[1]))
        if up is not None and p.refined_tilt < floor_error(frame, up, p) < 0.95 * p.floor_tilt
    ]
    whose = f" of the {wrong[0]}, whose own floor disagrees with it" if len(wrong) == 1 else ""
    return (
        f"the surfaces fit, but only tilted by {math.degrees(tilt):.0f} deg against `up`: a place "
        f"that looks alike, or a wrong `up`{whose}. Check the IMU's calibration and the axes of "
        "`up`"
    )


# The search.

#: What proposed a transform: patches alike, plans laid on each other, or the map's poses.
Search = Literal["correspondences", "plans", "guided"]


@dataclass(frozen=True)
class AlignmentParameters:
    """The numbers of the search for a transform."""

    matching: MatchingParameters = field(default_factory=MatchingParameters)
    consensus: ConsensusParameters = field(default_factory=ConsensusParameters)
    n_refined: int = 16  #: hypotheses that are refined
    score_stride: int = 2  #: of the points that hypotheses are scored on
    n_fine: int = 6  #: of two scans, that are refined finely before the best is taken
    fine_stride: int = 4  #: of the pixels for that
    violation_weight: float = 3.0  #: of a violation beside an inlier, in the score of hypotheses
    rank_violations: float = 1.0  #: of violations beside the share of planes, once refined
    same_m: float = 0.1  #: hypotheses this near are one
    same_rad: float = math.radians(6.0)
    coarse: RefinementParameters = COARSE
    fine: RefinementParameters = FINE
    lever: float = 1.0  #: in `stiffness` a radian counts as much as this many metres
    sequence: SequenceParameters = field(default_factory=SequenceParameters)
    plan: PlanParameters = field(default_factory=PlanParameters)
    gravity: GravityParameters = field(default_factory=GravityParameters)


@dataclass(frozen=True, eq=False)
class FrameSamples:
    """A frame as hypotheses are scored on it.

    Parameters
    ----------
    geometry : of the frame
    points : (N, 6) float32 of its surface, of `sampled`
    planes : see PlaneView
    up : (3,) unit vector in the sensor's coordinates, where it is known
    """

    geometry: Geometry
    points: Floats32
    planes: PlaneView
    up: Floats | None = None

    def plan(self, p: PlanParameters) -> ScanPlan:
        """Of a scan."""
        if self.up is not None:
            return plan_of(self.geometry.surface, p, up=self.up)
        return _upright_plan(self.geometry.surface, p)


@cached_per_frame
def _upright_plan(surface: Surface, p: PlanParameters) -> ScanPlan:
    return plan_of(surface, p)


def samples_of(
    geometry: Geometry, stride: int, p: PlaneParameters, up: Floats | None = None
) -> FrameSamples:
    """A frame made ready for `align`; stride in pixels."""
    return FrameSamples(geometry, sampled(geometry.surface, stride), plane_view(geometry, p), up)


@dataclass(frozen=True, eq=False)
class Alignment:
    """One direction's outcome.

    Parameters
    ----------
    T : (4, 4) T_target_source
    others : (n, 4, 4) the other hypotheses that were refined, best first
    stiffness : least over largest eigenvalue of the information, 0 where a direction is free
    refined : the last refinement, with its information; None where it was lost
    search : what proposed the transform
    proposed : (n, 4, 4) of scans, all hypotheses as they were proposed, best first
    """

    T: Floats
    others: Floats
    stiffness: float
    refined: Refined | None
    search: Search = "correspondences"
    proposed: Floats = field(default_factory=lambda: np.empty((0, 4, 4)))


def align(
    source: FrameSamples,
    target: FrameSamples,
    rng: np.random.Generator,
    p: AlignmentParameters,
    overlap_p: OverlapParameters,
    matching: Matching = "histograms",
) -> Alignment | None:
    """The transform from source to target: Sec. III-E, in one direction.

    Correspondences vote for some forty hypotheses; these are scored by how both frames' points fit
    the other's surface, the best distinct ones refined and ranked by how many planes agree, and
    the best refined to the end. Where up is known in both frames, what tilts is left out.

    Parameters
    ----------
    source, target : of two frames
    rng : of the patches drawn
    p, overlap_p : see there
    matching : what correspondences are found by

    Returns
    -------
    alignment : or None where no three correspondences agree, or no hypothesis survives refinement
    """
    a, b = source.geometry, target.geometry
    ups = source.up, target.up
    hypotheses = _voted(a, b, rng, p, matching, ups)
    scores = _scores(source, target, hypotheses, p, overlap_p)
    chosen = distinct(hypotheses, scores, p.same_m, p.same_rad, p.n_refined)
    refined = refined_all(a.surface, b.surface, hypotheses[chosen], p.coarse)
    refined = refined[are_level(refined, ups, p.gravity.refined_tilt)]
    if not len(refined):
        return None
    refined = refined[_ranked(source, target, refined, p, overlap_p)]
    return _finished(source, target, refined[0], refined[1:], p, "correspondences")


def align_scans(
    query: FrameSamples,
    match: FrameSamples,
    rng: np.random.Generator,
    p: AlignmentParameters,
    overlap_p: OverlapParameters,
    matching: Matching = "histograms",
    *,
    other_axes: bool = False,
) -> tuple[Alignment, Alignment] | None:
    """The transforms from query to match and back, of two scans: one search, refined each way.

    To the hypotheses of correspondences come those of the plans. The best few are refined finely
    before the best of all is taken: plans are coarse, and coarsely refined hypotheses rank badly.

    Parameters
    ----------
    query, match : of two scans
    rng, p, overlap_p, matching : as of `align`
    other_axes : whether the scanners may have stood otherwise than upright

    Returns
    -------
    alignments : there and back, or None where no hypothesis survives refinement
    """
    a, b = query.geometry, match.geometry
    ups = query.up, match.up
    voted = _voted(a, b, rng, p, matching, ups)
    plans = [(query.plan(p.plan), match.plan(p.plan))]
    if other_axes:
        plans = other_plans(a.surface, b.surface, p.plan)
    planned = plan_hypotheses(plans, p.plan)
    hypotheses = np.concatenate([voted, planned])
    scores = _scores(query, match, hypotheses, p, overlap_p)
    chosen = distinct(hypotheses, scores, p.same_m, p.same_rad, p.n_refined)
    transforms, index = refined_with_index(a.surface, b.surface, hypotheses[chosen], p.coarse)
    if not index:
        return None
    is_planned = np.array(chosen)[index] >= len(voted)
    level = are_level(transforms, ups, p.gravity.refined_tilt)
    transforms, is_planned = transforms[level], is_planned[level]
    if not len(transforms):
        return None
    order = _ranked(query, match, transforms, p, overlap_p)
    transforms, is_planned = transforms[order], is_planned[order]
    onto, numbers = b.surface.fitted, replace(p.fine, stride=p.fine_stride)
    fine, index = refined_with_index(a.surface, onto, transforms[: p.n_fine], numbers)
    transforms[index] = fine
    order = _ranked(query, match, transforms, p, overlap_p)
    T, others = transforms[order[0]], transforms[order[1:]]
    search: Search = "plans" if is_planned[order[0]] else "correspondences"
    there = _finished(query, match, T, others, p, search)
    back = _finished(match, query, inverse(T), inverses(others), p, search)
    return replace(there, proposed=hypotheses[np.argsort(-scores, kind="stable")]), back


def align_guided(
    source: FrameSamples, target: FrameSamples, T: Floats, p: AlignmentParameters
) -> Alignment | None:
    """A transform that is known beforehand, (4, 4) T_target_source, refined in one direction.

    Nothing is searched for. None where the surfaces do not hold it.
    """
    surface, onto = source.geometry.surface, target.geometry.surface
    coarse = refine(sampled(surface, p.coarse.stride), onto, T, p.coarse, kind_of(surface.camera))
    if coarse is None:
        return None
    found = _finished(source, target, coarse.T, np.empty((0, 4, 4)), p, "guided")
    return None if found.refined is None else found


def are_scans(query: Geometry, match: Geometry) -> bool:
    """Whether both frames are range images about a viewpoint."""
    return all(isinstance(one.surface.camera, Sphere) for one in (query, match))


def _voted(
    source: Geometry, target: Geometry, rng: np.random.Generator, p: AlignmentParameters,
    matching: Matching, ups: Ups,
) -> Floats:  # fmt: skip
    """What correspondences vote for, less what tilts."""
    pairs = _pairs(source, target, rng, p, matching, ups)
    voted = consensus(source.patches, target.patches, pairs, p.consensus)
    return voted[are_level(voted, ups, p.gravity.proposed_tilt)]


def _pairs(
    source: Geometry, target: Geometry, rng: np.random.Generator, p: AlignmentParameters,
    matching: Matching, ups: Ups,
) -> Ints32:  # fmt: skip
    gate = None
    if ups[0] is not None and ups[1] is not None:
        angles = slopes(source.patches.normals, ups[0]), slopes(target.patches.normals, ups[1])
        gate = SlopeGate(*angles, p.gravity.gate)
    if matching == "histograms":
        return correspondences(source.descriptors, target.descriptors, rng, p.matching, gate)
    pairs = sequence_correspondences(source.patches, target.patches, rng, p.sequence)
    if gate is None:
        return pairs
    return pairs[np.abs(gate.source[pairs[:, 0]] - gate.target[pairs[:, 1]]) <= gate.most]


def _finished(
    source: FrameSamples, target: FrameSamples, T: Floats, others: Floats, p: AlignmentParameters,
    search: Search,
) -> Alignment:  # fmt: skip
    """One transform refined to the end."""
    surface = source.geometry.surface
    onto = target.geometry.surface.fitted
    fine = refine(sampled(surface, p.fine.stride), onto, T, p.fine, kind_of(surface.camera))
    if fine is None:
        return Alignment(T, others, 0.0, None, search)
    scale = np.array([p.lever] * 3 + [1.0] * 3)
    eigenvalues = np.linalg.eigvalsh(fine.information / np.outer(scale, scale))
    stiffness = max(float(eigenvalues[0] / eigenvalues[-1]), 0.0)
    return Alignment(fine.T, others, stiffness, fine, search)


def _scores(
    source: FrameSamples, target: FrameSamples, transforms: Floats, p: AlignmentParameters,
    overlap_p: OverlapParameters,
) -> Floats:  # fmt: skip
    """Share of the inliers, less violations, of both frames' points."""
    total = np.zeros(len(transforms))
    for one, other, each in (
        (source, target, transforms), (target, source, inverses(transforms)),
    ):  # fmt: skip
        points = one.points[:: p.score_stride]
        counts = agreements(points, other.geometry.surface, each, overlap_p)
        total += (counts[:, 0] - p.violation_weight * counts[:, 1]) / max(len(points), 1)
    return total


def _ranked(
    source: FrameSamples, target: FrameSamples, transforms: Floats, p: AlignmentParameters,
    overlap_p: OverlapParameters,
) -> Ints32:  # fmt: skip
    """Indices of refined transforms, best first."""
    seen = explained(source.planes, target.planes, transforms, overlap_p)
    scores = seen.share - p.rank_violations * seen.violations
    return np.argsort(-scores, kind="stable").astype(np.int32)
