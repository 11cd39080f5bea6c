"""Sec. III-E, acceptance: decide by the evidence for a transform and its rivals to accept it.

    Evidence  --objection-->  why not        Evidence, ambiguity  --belief-->  how far
    Evidence, deviation  --sparse_evidence_suffices-->  whether little is enough
    T, hypotheses, planes  --best_alternative-->  ambiguity, T_alternative

A lone box looks the same from its four sides, a corridor the same at every door. Two frames of
such a place agree perfectly under a wrong transform, and nothing in the residual, the overlap or
the free space shows it. What does show is that *another* transform is not refuted either. So
rivals are looked for: the other hypotheses that correspondences voted for, and the transform
found, turned by quarter turns about the normals of the main planes or shifted along them, which
is how rooms and what stands in them repeat.

What a rival agrees on counts by planes (`overlap.py`). Where up is known in both frames, what tilts
against it is no rival.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np

from sceneprint.geometry.kernel import cached_per_frame, disjoint_kernel
from sceneprint.geometry.registration.icp import COARSE, QUICK, RefinementParameters, refine_all
from sceneprint.geometry.registration.overlap import (
    OverlapParameters,
    PlaneParameters,
    PlaneView,
    plane_agreement,
)
from sceneprint.geometry.rigid import NO_UPS, Ups, are_level, are_near, select_distinct
from sceneprint.types import Floats, Patches

Status = Literal["accepted", "ambiguous", "rejected"]
Strength = Literal["strong", "weak"]
Mode = Literal["full", "paper"]


@dataclass(frozen=True)
class AcceptanceParameters:
    """The numbers of acceptance; how they were chosen: docs/evaluation.md."""

    residual_m: float = 0.08  #: of the two directions composed: epsilon_val of Sec. III-E
    residual_rad: float = math.radians(5.0)
    violation_weight: float = 5.0  #: evidence = overlap - this x violations
    evidence: float = 0.2  #: least
    plane_overlap: float = 0.15  #: least
    net_weight: float = 3.0  #: net plane overlap = plane overlap - this x violations
    net: float = 0.1  #: least of it
    net_strong: float = 0.1  #: of it, below which an accepted match is weak
    planes: float = 0.0  #: least number of distinct planes that agree
    plane_violations: float = 1.0  #: most, by planes
    worst_violations: float = 0.05  #: most, in the worse of the two directions
    strong: float = 0.3  #: evidence below which an accepted match is weak
    weak: float = 0.05  #: ambiguity from which on an accepted match is weak
    ambiguous: float = 0.14  #: ambiguity from which on nothing is accepted
    ambiguous_share: float = 0.5  #: nor from this share of `plane_overlap` on
    stiffness: float = 1e-5  #: least ratio of the eigenvalues of the information
    blind_evidence: float = 0.4  #: least where nothing is known of free space
    blind_plane_overlap: float = 0.3  #: and least of `plane_overlap`
    blind_ambiguous_share: float = 0.75  #: of which, in the place of both above: fewer rivals fall
    sparse_evidence: float = 0.1  #: least where little is shared, or one search alone found it
    sparse_plane_overlap: float = 0.1  #: and least of `plane_overlap`
    sparse_planes: float = 5.0  #: and least number of distinct planes
    alone_planes: float = 6.0  #: the same of what one search alone found
    sparse_plane_violations: float = 0.06  #: and most of `plane_violations`
    sparse_worst_violations: float = 0.03  #: and most of `worst_violations`
    sparse_deviation_m: float = 0.045  #: and most of the deviation of the translation, metres
    apart_m: float = 0.2  #: most of the residual, where one search found it and both refine it
    apart_rad: float = math.radians(4.0)
    apart_planes: float = 12.0  #: then least number of distinct planes, beyond `residual_m`
    apart_plane_overlap: float = 0.2  #: and least of `plane_overlap`


@dataclass(frozen=True)
class Evidence:
    """The evidence for and against a transform, before its rivals are searched.

    Parameters
    ----------
    residual_m, residual_rad, overlap, plane_overlap : as in Validation
    violations : as in Validation; None where there is no evidence of free space
    stiffness : the less of both directions', as in Alignment
    one_sided : free space of one of the frames is not known
    planes : how many distinct planes agree, the mean of both frames
    plane_violations : free-space violations with every plane counting the same, as a share of
        what agrees or violates
    worst_violations : violations of the frame that violates more, as a share of its own
    """

    residual_m: float
    residual_rad: float
    overlap: float
    plane_overlap: float
    violations: float | None
    stiffness: float
    one_sided: bool = False
    planes: float = math.inf
    plane_violations: float = 0.0
    worst_violations: float = 0.0

    def total(self, p: AcceptanceParameters) -> float:
        """Return the overlap less the weighted violations."""
        return self.overlap - p.violation_weight * (self.violations or 0.0)

    def net(self, p: AcceptanceParameters) -> float:
        """Return the plane overlap less the weighted violations."""
        return self.plane_overlap - p.net_weight * (self.violations or 0.0)


def objection(e: Evidence, p: AcceptanceParameters, mode: Mode) -> tuple[Status, str] | None:
    """Return why not to accept a transform, whatever its rivals, or None: Sec. III-E.

    Parameters
    ----------
    e : see Evidence
    p : see AcceptanceParameters
    mode : "paper" asks for the residual alone
    """
    if e.residual_m > p.residual_m or e.residual_rad > p.residual_rad:
        if not math.isfinite(e.residual_m):
            return "rejected", "only one of the two directions found a transform"
        metres, degrees = _two_digits(e.residual_m), _two_digits(math.degrees(e.residual_rad))
        return "rejected", f"the two directions disagree by {metres} m, {degrees} deg"
    if mode == "paper":
        return None
    blind = e.violations is None
    evidence = p.blind_evidence if blind else p.evidence
    if e.total(p) < evidence:
        if e.violations is None:
            return "rejected", f"only {e.overlap:.0%} agrees, and free space is not known"
        if e.overlap < evidence:
            return "rejected", f"only {e.overlap:.0%} of the surfaces agree"
        return "rejected", f"{e.violations:.1%} lies where the other frame saw through"
    if e.plane_overlap < (p.blind_plane_overlap if blind else p.plane_overlap):
        return "rejected", f"what agrees is mostly one plane ({e.plane_overlap:.0%} by planes)"
    if e.net(p) < p.net:
        return "rejected", (
            f"{e.plane_overlap:.0%} agrees by planes, and {e.violations or 0.0:.1%} lies where the "
            "other frame saw through"
        )
    if e.plane_violations > p.plane_violations or e.worst_violations > p.worst_violations:
        share = max(e.plane_violations, e.worst_violations)
        return "rejected", f"{share:.1%} lies where the other frame saw through"
    if e.planes < p.planes:
        return "ambiguous", (
            f"only {e.planes:.0f} distinct planes agree, too few to tell corridors apart"
        )
    if e.stiffness < p.stiffness:
        return "ambiguous", "what the frames share leaves a direction free, as a plane does"
    return None


def sparse_evidence_suffices(
    e: Evidence, deviation_m: float, p: AcceptanceParameters, *, alone: bool = False
) -> bool:
    """Return whether little evidence is enough, because all of it speaks for the transform.

    Two frames that share a tenth of what they see cannot show the overlap that `objection` asks
    for, and the search from one of them may miss what the search from the other finds. Such a
    transform must be refined to the same place in both directions, several planes must agree,
    next to nothing may lie in free space of either frame, and the surfaces must fix it firmly.
    Depth that a sensor distorts lets the two refinements of a right transform settle some
    centimetres apart: there many planes must agree.

    Parameters
    ----------
    e : of the transform, with the residual of its two refinements
    deviation_m : standard deviation of its translation, metres
    p : see AcceptanceParameters
    alone : whether only one of the two searches found it
    """
    if e.violations is None or e.one_sided:
        return False
    if (
        e.net(p) < p.net
        or e.plane_violations > min(p.plane_violations, p.sparse_plane_violations)
        or e.stiffness < p.stiffness
    ):
        return False
    if e.residual_m <= p.residual_m and e.residual_rad <= p.residual_rad:
        return (
            e.total(p) >= p.sparse_evidence
            and e.plane_overlap >= p.sparse_plane_overlap
            and e.planes >= max(p.planes, p.alone_planes if alone else p.sparse_planes)
            and e.worst_violations <= min(p.worst_violations, p.sparse_worst_violations)
            and deviation_m <= p.sparse_deviation_m
        )
    return (
        alone
        and e.residual_m <= p.apart_m
        and e.residual_rad <= p.apart_rad
        and e.plane_overlap >= p.apart_plane_overlap
        and e.planes >= max(p.planes, p.apart_planes)
        and e.worst_violations <= p.worst_violations
    )


def belief(
    e: Evidence, ambiguity: float, p: AcceptanceParameters
) -> tuple[Status, Strength | None, str]:
    """Return the status, strength and reason of a transform that has no objection but rivals."""
    most = min(p.ambiguous, p.ambiguous_share * e.plane_overlap)
    if e.violations is None:  # no rival is refuted by free space either
        most = p.blind_ambiguous_share * e.plane_overlap
    if ambiguity >= most:
        return "ambiguous", None, "another transform explains the frames as well"
    if e.violations is None:
        return "accepted", "weak", "surfaces agree, but nothing is known of free space"
    if ambiguity >= p.weak:
        return "accepted", "weak", "another transform is not ruled out"
    if e.total(p) < p.strong or e.net(p) < p.net_strong:
        return "accepted", "weak", f"{e.overlap:.0%} of the surfaces agree"
    if e.one_sided:  # what one frame has and the other lacks may speak against it unheard
        return "accepted", "weak", "surfaces agree, but free space is known of one frame only"
    return "accepted", "strong", "surfaces agree, and nothing speaks against it"


def _two_digits(value: float) -> str:
    """Return a number with two digits and no exponent: 130, not 1.3e+02."""
    return f"{value:.0f}" if value >= 10 else f"{value:.2g}"


# Ambiguity: other transforms that would explain the same two frames.


@dataclass(frozen=True)
class AmbiguityParameters:
    """The numbers of the search for rivals."""

    n_axes: int = 2  #: directions that most surface faces
    n_planes: int = 3  #: planes across each, by area
    same_direction: float = math.radians(12.0)  #: normals this near are parallel
    shift: float = 0.5  #: steps along a corridor, metres: what refinement can bridge
    n_shifts: int = 6  #: each way
    least_crossing: float = 0.5  #: sine of the angle between the main families of planes
    n_proposed: int = 16  #: hypotheses of the plans that are refined as rivals
    planes: PlaneParameters = field(default_factory=PlaneParameters)
    first: RefinementParameters = QUICK  #: of all
    hopeful_share: float = 0.04  #: after it, those that explain less are dropped
    hopeful_violations: float = 0.15  #: and those that violate more
    then: RefinementParameters = COARSE  #: of the rest
    refuted: float = 0.02  #: violations from which on a rival is none, if the transform has fewer
    rival_m: float = 0.25  #: a rival differs by this, metres
    rival_rad: float = math.radians(15.0)  #: or by this


@cached_per_frame
def symmetries(patches: Patches, p: AmbiguityParameters) -> Floats:
    """Return motions that map the main planes of the patches onto themselves.

    These are turns by 90, 180 and 270 degrees about the middle of each plane, and shifts along the
    direction in which the two main families of planes both run, as a corridor does.

    Parameters
    ----------
    patches : P of one frame
    p : see AmbiguityParameters

    Returns
    -------
    (n, 4, 4) with n at most 3 n_axes n_planes + 2 n_shifts
    """
    left = patches.areas.copy()
    normals, mass = np.ascontiguousarray(patches.normals.T), np.empty(len(patches))
    motions: list[Floats] = []
    axes: list[Floats] = []
    for _ in range(p.n_axes):
        _facing(normals, left, math.cos(p.same_direction), mass)
        most = int(np.argmax(mass))
        if left[most] <= 0:
            break
        cosines = (patches.normals * patches.normals[most]).sum(axis=1)
        across = np.abs(cosines) > math.cos(p.same_direction)
        signed = np.sign(cosines) * patches.areas * across
        axis = (patches.normals * signed[:, None]).sum(axis=0)
        axis /= np.linalg.norm(axis)
        axes.append(axis)
        middles = _middles(patches, axis, np.where(across, left, 0.0), p)
        motions += _turns(axis, middles)
        left = np.where(across, 0.0, left)
    if len(axes) > 1:
        along = np.cross(axes[0], axes[1])
        length = float(np.linalg.norm(along))
        if length > p.least_crossing:
            steps = p.shift * np.arange(1, p.n_shifts + 1)
            motions += [_shift(along / length * s) for s in np.concatenate([steps, -steps])]
    return np.array(motions).reshape(-1, 4, 4)


def _middles(patches: Patches, axis: Floats, area: Floats, p: AmbiguityParameters) -> list[Floats]:
    """Return the middles of the largest planes across an axis, of patches that have an area."""
    offsets, mass = (patches.means * axis).sum(axis=1), np.empty(len(patches))
    middles: list[Floats] = []
    for _ in range(p.n_planes):
        _level(offsets, area, p.planes.same_plane, mass)
        best = int(np.argmax(np.where(area > 0, mass, 0.0)))
        if area[best] <= 0:
            break
        on_plane = (np.abs(offsets - offsets[best]) < p.planes.same_plane) & (area > 0)
        middles.append(np.average(patches.means[on_plane], axis=0, weights=area[on_plane]))
        area = np.where(on_plane, 0.0, area)
    return middles


@disjoint_kernel
def _facing(normals: Floats, areas: Floats, cosine: float, mass: Floats) -> None:
    """Sum, for each patch, the areas of those that face its way or away from it; normals (3, P).

    The inner loop runs over the sums, not over the terms of one sum, so that it vectorises.
    """
    x, y, z = normals[0], normals[1], normals[2]
    mass[:] = 0.0
    for j in range(len(areas)):
        a, b, c, area = x[j], y[j], z[j], areas[j]
        if area > 0:
            for i in range(len(areas)):
                mass[i] += area if abs(a * x[i] + b * y[i] + c * z[i]) > cosine else 0.0


@disjoint_kernel
def _level(offsets: Floats, areas: Floats, apart: float, mass: Floats) -> None:
    """Sum, for each patch, the areas of those with a near offset, as `_facing` does."""
    mass[:] = 0.0
    for j in range(len(areas)):
        offset, area = offsets[j], areas[j]
        if area > 0:
            for i in range(len(areas)):
                mass[i] += area if abs(offset - offsets[i]) < apart else 0.0


def _shift(by: Floats) -> Floats:
    result = np.eye(4)
    result[:3, 3] = by
    return result


def _turns(axis: Floats, middles: list[Floats]) -> list[Floats]:
    """Return turns by 90, 180 and 270 degrees about an axis through each of some points."""
    x, y, z = axis
    cross, outer = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]), np.outer(axis, axis)
    rotations = [
        cosine * np.eye(3) + sine * cross + (1 - cosine) * outer
        for cosine, sine in ((0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))
    ]
    turns = []
    for middle in middles:
        for R in rotations:
            turn = np.eye(4)
            turn[:3, :3], turn[:3, 3] = R, middle - R @ middle
            turns.append(turn)
    return turns


def far_from(T: Floats, others: Floats, p: AmbiguityParameters) -> Floats:
    """Return those of the others (n, 4, 4) that differ from T enough to be rivals."""
    return others[~are_near(others, T, p.rival_m, p.rival_rad)]


class Rival(NamedTuple):
    """The best rival of a transform.

    Parameters
    ----------
    share : that it explains, every plane counting the same, 0 to 1; 0 where there is none
    T : (4, 4) of it, or None
    tilted : share that the best of those explains that tilt against `up`, and that nothing else
        refutes
    """

    share: float
    T: Floats | None
    tilted: float = 0.0


def best_alternative(
    query: PlaneView, match: PlaneView, T: Floats, violations: float, voted: Floats,
    proposed: Floats, p: AmbiguityParameters, agreement_p: OverlapParameters,
    ups: Ups = NO_UPS, most_tilt: float = math.inf,
) -> Rival:  # fmt: skip
    """Return the best rival of T, and the share of the frames that it explains: Sec. III-E.

    Parameters
    ----------
    query, match : of `plane_view`
    T : (4, 4) T_match_query
    violations : of T, with every plane counting the same: free space refutes no rival for what it
        holds against T as well
    voted : (n, 4, 4) other hypotheses, refined
    proposed : (m, 4, 4) hypotheses that were not, best first: of those that differ from T and
        from each other as rivals do, the best are refined now
    p, agreement_p : see there
    ups : of query and match
    most_tilt : radians against them beyond which a transform is no rival
    """
    moved = np.concatenate([symmetries(match.patches, p) @ T, T @ symmetries(query.patches, p)])
    near = far_from(T, refine_all(query.surface, match.surface, moved, p.first), p)
    seen = plane_agreement(query, match, near, agreement_p)
    hopeful = near[(seen.share > p.hopeful_share) & (seen.violations < p.hopeful_violations)]
    proposed = far_from(T, proposed, p)
    order = -np.arange(len(proposed), dtype=float)
    chosen = select_distinct(proposed, order, p.rival_m, p.rival_rad, p.n_proposed)
    hopeful = np.concatenate([hopeful, proposed[chosen]])
    rivals = np.concatenate([voted, refine_all(query.surface, match.surface, hopeful, p.then)])
    rivals = far_from(T, rivals, p)
    seen = plane_agreement(query, match, rivals, agreement_p)
    share = np.where(seen.violations < max(p.refuted, violations), seen.share, 0.0)
    level = are_level(rivals, ups, most_tilt)
    tilted = float(share[~level].max(initial=0.0))
    share = np.where(level, share, 0.0)
    if not (share > 0).any():
        return Rival(0.0, None, tilted)
    best = int(np.argmax(share))
    return Rival(float(share[best]), rivals[best], tilted)
