"""Decision whether to accept a transform, from its evidence and rival transforms (Sec. III-E).

    Evidence  --objection-->  reason to reject     Evidence, ambiguity  --belief-->  strength
    Evidence, deviation  --sparse_evidence_suffices-->  whether sparse evidence is enough
    T, hypotheses, planes  --best_alternative-->  Rival

A box looks the same from its four sides, and a corridor looks the same at every door. Two frames of
such a place can agree perfectly under a wrong transform; only other, equally good transforms reveal
the error. Therefore, rivals are sought among the other hypotheses from correspondences, and among
copies of the transform that are rotated by quarter turns about the normals of the main planes or
shifted along these planes, because rooms and furniture repeat in these ways.

All planes have the same weight in the agreement of a rival (`overlap.py`). If up is known in both
frames, a transform that tilts is not a rival.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np

from sceneprint.geometry.kernel import cached_per_frame, disjoint_kernel, kernel
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
    """Parameters of acceptance; docs/evaluation.md describes how they were tuned.

    "blind" limits apply if free space is unknown, "sparse" limits if the frames share little
    surface or only one search found the transform, "apart" limits if the two refinements of such a
    transform differ by more than `residual_m`, and "sliced" limits if height slices of two scans
    support the transform.
    """

    residual_m: float = 0.08  #: epsilon_val: maximum residual of T_ab T_ba, metres
    residual_rad: float = math.radians(5.0)  #: the same for the rotation, radians
    violation_weight: float = 5.0  #: evidence = overlap - violation_weight * violations
    evidence: float = 0.2  #: minimum evidence
    plane_overlap: float = 0.15  #: minimum plane overlap
    net_weight: float = 3.0  #: net plane overlap = plane overlap - net_weight * violations
    net: float = 0.1  #: minimum net plane overlap
    #: With more distinct planes than this, `many_planes_net` replaces `net`.
    many_planes: float = math.inf
    many_planes_net: float = 0.06  #: minimum net plane overlap if many planes agree
    net_strong: float = 0.1  #: minimum net plane overlap of a strong match
    planes: float = 0.0  #: minimum number of distinct planes that agree
    plane_violations: float = 1.0  #: maximum share of violations, with equal weights for planes
    worst_violations: float = 0.05  #: maximum share of violations in either direction
    strong: float = 0.3  #: minimum evidence of a strong match
    weak: float = 0.05  #: minimum ambiguity of an accepted match that is weak
    ambiguous: float = 0.14  #: minimum ambiguity at which no match is accepted
    ambiguous_share: float = 0.5  #: maximum ambiguity as a share of `plane_overlap`
    stiffness: float = 1e-5  #: minimum `stiffness` of the evidence
    blind_evidence: float = 0.4  #: minimum evidence
    blind_plane_overlap: float = 0.3  #: minimum plane overlap
    blind_ambiguous_share: float = 0.75  #: replaces both ambiguity limits: fewer rivals are refuted
    sparse_evidence: float = 0.1  #: minimum evidence
    sparse_plane_overlap: float = 0.1  #: minimum plane overlap
    sparse_planes: float = 5.0  #: minimum number of distinct planes
    alone_planes: float = 6.0  #: `sparse_planes` if only one search found the transform
    sparse_plane_violations: float = 0.06  #: maximum `plane_violations`
    sparse_worst_violations: float = 0.03  #: maximum `worst_violations`
    sparse_deviation_m: float = 0.045  #: maximum deviation of the translation, metres
    apart_m: float = 0.2  #: maximum residual of the two refinements, metres
    apart_rad: float = math.radians(4.0)  #: maximum residual of the two refinements, radians
    apart_planes: float = 12.0  #: minimum number of distinct planes
    apart_plane_overlap: float = 0.2  #: minimum plane overlap
    sliced_planes: float = 3.0  #: minimum number of distinct planes
    sliced_violations: float = 0.03  #: maximum share of violations
    sliced_plane_violations: float = 0.2  #: maximum `plane_violations`


@dataclass(frozen=True)
class Evidence:
    """The evidence for and against a transform, before the search for rivals.

    Parameters
    ----------
    residual_m, residual_rad, overlap, plane_overlap : see PairValidation
    violations : see PairValidation; None if free space is unknown
    stiffness : smaller of the stiffnesses of the two directions; see Alignment
    one_sided : whether free space of one of the frames is unknown
    planes : number of distinct planes that agree, averaged over both frames
    plane_violations : share of free-space violations, with equal weights for all planes
    worst_violations : share of violations of the frame that has more of them
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
        """Return the overlap minus the weighted violations."""
        return self.overlap - p.violation_weight * (self.violations or 0.0)

    def net(self, p: AcceptanceParameters) -> float:
        """Return the plane overlap minus the weighted violations."""
        return self.plane_overlap - p.net_weight * (self.violations or 0.0)


_IN_FREE_SPACE = "of the points lie where the other frame saw free space"


def objection(e: Evidence, p: AcceptanceParameters, mode: Mode) -> tuple[Status, str] | None:
    """Return the status and the reason if a transform fails regardless of rivals, else None.

    The status is "rejected" or, if the evidence is inconclusive, "ambiguous" (Sec. III-E). Mode
    "paper" checks the residual only.
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
            agreeing = f"{e.overlap:.0%} of the surfaces"
            return "rejected", f"only {agreeing} agree, and free space is unknown"
        if e.overlap < evidence:
            return "rejected", f"only {e.overlap:.0%} of the surfaces agree"
        return "rejected", f"{e.violations:.1%} {_IN_FREE_SPACE}"
    if e.plane_overlap < (p.blind_plane_overlap if blind else p.plane_overlap):
        return "rejected", f"mostly one plane agrees (plane overlap {e.plane_overlap:.0%})"
    if e.net(p) < (p.many_planes_net if e.planes > p.many_planes else p.net):
        return "rejected", (
            f"the plane overlap is {e.plane_overlap:.0%}, but {e.violations or 0.0:.1%} "
            f"{_IN_FREE_SPACE}"
        )
    if e.plane_violations > p.plane_violations or e.worst_violations > p.worst_violations:
        share = max(e.plane_violations, e.worst_violations)
        return "rejected", f"{share:.1%} {_IN_FREE_SPACE}"
    if e.planes < p.planes:
        return "ambiguous", (
            f"only {e.planes:.0f} distinct planes agree, too few to distinguish corridors"
        )
    if e.stiffness < p.stiffness:
        return "ambiguous", "the common surfaces do not constrain one direction"
    return None


def sparse_evidence_suffices(
    e: Evidence, deviation_m: float, p: AcceptanceParameters, *, alone: bool = False
) -> bool:
    """Return whether sparse evidence suffices because all of it supports the transform.

    Two frames that share a tenth of their surfaces cannot reach the overlap that `objection`
    requires, and one of the searches may miss the transform. For such a transform, the refinements
    in both directions and several planes must agree, almost no points may lie in the free space of
    either frame, and the surfaces must constrain it well. Distorted depth can separate the two
    refinements of a correct transform by a few centimetres; then many planes must agree.

    Parameters
    ----------
    e : evidence, with the residual between the two refinements
    deviation_m : standard deviation of the translation, metres
    alone : whether only one of the two searches found the transform
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


def sliced_evidence_suffices(e: Evidence, p: AcceptanceParameters) -> bool:
    """Return whether the evidence suffices for a transform that height slices of scans support.

    Slices support a transform much more than any other, so no rivals are sought, and a few planes
    and little free space suffice to confirm it.
    """
    return (
        e.violations is not None
        and not e.one_sided
        and e.violations <= p.sliced_violations
        and e.plane_violations <= p.sliced_plane_violations
        and e.planes >= p.sliced_planes
        and e.residual_m <= p.residual_m
        and e.residual_rad <= p.residual_rad
        and e.stiffness >= p.stiffness
    )


def belief(
    e: Evidence, ambiguity: float, p: AcceptanceParameters
) -> tuple[Status, Strength | None, str]:
    """Return the status, strength and reason for a transform without an `objection`."""
    most = min(p.ambiguous, p.ambiguous_share * e.plane_overlap)
    if e.violations is None:  # free space is unknown, so it refutes no rival
        most = p.blind_ambiguous_share * e.plane_overlap
    if ambiguity >= most:
        return "ambiguous", None, "another transform explains the frames equally well"
    if e.violations is None:
        return "accepted", "weak", "the surfaces agree, but free space is unknown"
    if ambiguity >= p.weak:
        return "accepted", "weak", "another transform is possible too"
    if e.total(p) < p.strong or e.net(p) < p.net_strong:
        return "accepted", "weak", f"{e.overlap:.0%} of the surfaces agree"
    if e.one_sided:  # violations of unknown free space cannot be detected
        return "accepted", "weak", "the surfaces agree, but free space is known for one frame only"
    return "accepted", "strong", "the surfaces agree, and there is no evidence against it"


def _two_digits(value: float) -> str:
    """Format a number with two digits and without an exponent: 130, not 1.3e+02."""
    return f"{value:.0f}" if value >= 10 else f"{value:.2g}"


@dataclass(frozen=True)
class AmbiguityParameters:
    """Parameters of the search for rivals."""

    n_axes: int = 2  #: number of main directions of normals
    n_planes: int = 3  #: number of largest planes per direction
    same_direction: float = math.radians(12.0)  #: maximum angle between parallel normals
    shift: float = 0.5  #: step along a corridor, metres; small enough that refinements converge
    n_shifts: int = 6  #: number of steps in each direction
    least_crossing: float = 0.5  #: minimum sine of the angle between the main families of planes
    n_proposed: int = 16  #: number of hypotheses from plans that are refined as rivals
    planes: PlaneParameters = field(default_factory=PlaneParameters)
    first: RefinementParameters = QUICK  #: refinement of all rivals
    hopeful_share: float = 0.04  #: minimum share that a rival explains after the first refinement
    hopeful_violations: float = 0.15  #: maximum share of a rival's violations after it
    then: RefinementParameters = COARSE  #: refinement of rivals that remain hopeful
    refuted: float = 0.02  #: share of violations that refutes a rival, unless T has more
    rival_m: float = 0.25  #: minimum difference of a rival from the transform, metres
    rival_rad: float = math.radians(15.0)  #: or minimum rotation relative to it, radians


@cached_per_frame
def symmetries(patches: Patches, p: AmbiguityParameters) -> Floats:
    """Return motions (n, 4, 4) that map the main planes of the patches onto themselves.

    These are rotations by 90, 180 and 270 degrees about the normal through the centre of each
    plane, and shifts along the intersection of the two main families of planes, such as along a
    corridor. n is at most 3 n_axes n_planes + 2 n_shifts.
    """
    motions = np.zeros((3 * p.n_axes * p.n_planes + 2 * p.n_shifts, 4, 4))
    means, normals = (np.ascontiguousarray(x.T) for x in (patches.means, patches.normals))
    count = _write_symmetries(
        means, normals, patches.areas, p.n_axes, p.n_planes, math.cos(p.same_direction),
        p.planes.same_plane, p.least_crossing, p.shift, p.n_shifts, motions,
    )  # fmt: skip
    return motions[:count]


@kernel
def _write_symmetries(
    means: Floats, normals: Floats, areas: Floats, n_axes: int, n_planes: int, cosine: float,
    same_plane: float, least_crossing: float, shift: float, n_shifts: int, motions: Floats,
) -> int:  # fmt: skip
    """Write the motions of `symmetries`; return their number. Means and normals are (3, P)."""
    remaining, mass, axes = areas.copy(), np.empty(len(areas)), np.zeros((n_axes + 2, 3))
    count = 0
    for number in range(n_axes):
        _sum_parallel(normals, remaining, cosine, mass)
        most = int(np.argmax(mass))
        if remaining[most] <= 0:
            break
        axis, across = np.zeros(3), np.zeros(len(areas))
        for i in range(len(areas)):
            dot = 0.0
            for k in range(3):
                dot += normals[k, i] * normals[k, most]
            if abs(dot) > cosine:
                across[i], remaining[i] = remaining[i], 0.0
                for k in range(3):
                    axis[k] += normals[k, i] * areas[i] * np.sign(dot)
        axis /= np.sqrt((axis * axis).sum())
        count = _write_turns(means, across, axis, n_planes, same_plane, mass, motions, count)
        axes[number] = axis
    along = np.array([  # 0 without two axes
        axes[0, 1] * axes[1, 2] - axes[0, 2] * axes[1, 1],
        axes[0, 2] * axes[1, 0] - axes[0, 0] * axes[1, 2],
        axes[0, 0] * axes[1, 1] - axes[0, 1] * axes[1, 0],
    ])  # fmt: skip
    length = np.sqrt((along * along).sum())
    if length > least_crossing:
        for step in range(2 * n_shifts):
            metres = shift * (step + 1) if step < n_shifts else -shift * (step + 1 - n_shifts)
            motions[count] = np.eye(4)
            motions[count, :3, 3] = along / length * metres
            count += 1
    return count


@kernel
def _write_turns(
    means: Floats, areas: Floats, axis: Floats, n_planes: int, same_plane: float, mass: Floats,
    motions: Floats, count: int,
) -> int:  # fmt: skip
    """Append quarter turns about the centres of the largest planes across an axis to `motions`.

    Planes consist of patches with positive areas; these areas are set to 0. `count` is the number
    of motions already written; return the new number.
    """
    x, y, z = axis[0], axis[1], axis[2]
    offsets, R = x * means[0] + y * means[1] + z * means[2], np.empty((3, 3))
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    for _ in range(n_planes):
        _sum_level(offsets, areas, same_plane, mass)
        best = int(np.argmax(np.where(areas > 0, mass, 0.0)))
        if areas[best] <= 0:
            break
        middle, total = np.zeros(3), 0.0
        for i in range(len(areas)):
            if abs(offsets[i] - offsets[best]) < same_plane and areas[i] > 0:
                total += areas[i]
                for k in range(3):
                    middle[k] += means[k, i] * areas[i]
                areas[i] = 0.0
        middle /= total
        for cosine, sine in ((0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)):
            for a in range(3):
                for b in range(3):
                    R[a, b] = sine * cross[a, b] + (1.0 - cosine) * axis[a] * axis[b]
                    R[a, b] += cosine if a == b else 0.0
            motions[count, :3, :3], motions[count, 3, 3] = R, 1.0
            for a in range(3):
                turned = R[a, 0] * middle[0] + R[a, 1] * middle[1] + R[a, 2] * middle[2]
                motions[count, a, 3] = middle[a] - turned
            count += 1
    return count


@disjoint_kernel
def _sum_parallel(normals: Floats, areas: Floats, cosine: float, mass: Floats) -> None:
    """Write, for each patch, the total area of parallel patches; normals are (3, P).

    The inner loop runs over the sums, not over the terms of a sum, so that it is vectorized.
    """
    x, y, z = normals[0], normals[1], normals[2]
    mass[:] = 0.0
    for j in range(len(areas)):
        a, b, c, area = x[j], y[j], z[j], areas[j]
        if area > 0:
            for i in range(len(areas)):
                mass[i] += area if abs(a * x[i] + b * y[i] + c * z[i]) > cosine else 0.0


@disjoint_kernel
def _sum_level(offsets: Floats, areas: Floats, apart: float, mass: Floats) -> None:
    """Write, for each patch, the total area of the patches with a similar offset."""
    mass[:] = 0.0
    for j in range(len(areas)):
        offset, area = offsets[j], areas[j]
        if area > 0:
            for i in range(len(areas)):
                mass[i] += area if abs(offset - offsets[i]) < apart else 0.0


def select_rivals(T: Floats, others: Floats, p: AmbiguityParameters) -> Floats:
    """Return the transforms (n, 4, 4) that differ from T enough to be rivals."""
    return others[~are_near(others, T, p.rival_m, p.rival_rad)]


class Rival(NamedTuple):
    """The best rival of a transform.

    Parameters
    ----------
    share : share of the frames that the rival explains, with equal weights for all planes, 0 to 1;
        0 if there is no rival
    T : (4, 4) transform; None if there is no rival
    tilted : largest share explained by a transform that only `up` refutes
    """

    share: float
    T: Floats | None
    tilted: float = 0.0


def best_alternative(
    query: PlaneView, match: PlaneView, T: Floats, violations: float, voted: Floats,
    proposed: Floats, p: AmbiguityParameters, agreement_p: OverlapParameters,
    ups: Ups = NO_UPS, most_tilt: float = math.inf,
) -> Rival:  # fmt: skip
    """Search for the best rival of T: Sec. III-E.

    Parameters
    ----------
    query, match : results of `plane_view`
    T : (4, 4) T_match_query
    violations : share of violations of T, with equal weights for planes; up to this share,
        violations do not refute a rival
    voted : (n, 4, 4) other refined hypotheses
    proposed : (m, 4, 4) unrefined hypotheses, best first; the best hypotheses that are rivals of T
        and of each other are refined
    ups : up vectors of query and match
    most_tilt : maximum tilt of a rival, radians
    """
    moved = np.concatenate([symmetries(match.patches, p) @ T, T @ symmetries(query.patches, p)])
    near = select_rivals(T, refine_all(query.surface, match.surface, moved, p.first), p)
    result = plane_agreement(query, match, near, agreement_p)
    hopeful = near[(result.share > p.hopeful_share) & (result.violations < p.hopeful_violations)]
    proposed = select_rivals(T, proposed, p)
    order = -np.arange(len(proposed), dtype=float)
    chosen = select_distinct(proposed, order, p.rival_m, p.rival_rad, p.n_proposed)
    hopeful = np.concatenate([hopeful, proposed[chosen]])
    rivals = np.concatenate([voted, refine_all(query.surface, match.surface, hopeful, p.then)])
    rivals = select_rivals(T, rivals, p)
    result = plane_agreement(query, match, rivals, agreement_p)
    share = np.where(result.violations < max(p.refuted, violations), result.share, 0.0)
    level = are_level(rivals, ups, most_tilt)
    tilted = float(share[~level].max(initial=0.0))
    share = np.where(level, share, 0.0)
    if not (share > 0).any():
        return Rival(0.0, None, tilted)
    best = int(np.argmax(share))
    return Rival(float(share[best]), rivals[best], tilted)
