"""Sec. III-E, validation: align two frames by a rigid transform, and decide whether it is right.

    Geometry, Geometry, seed  --validate-->  Validation
    validations  --preferred-->  C_vld

The transform is estimated both ways, independently. That both agree is the paper's test. By
itself it believes too much: two estimates from the same two frames may fall into the same wrong
place, where plane lies on plane. So the transform must also explain what both sensors saw: enough
of both surfaces agrees, and next to nothing lies where the other frame saw through.

By itself it also believes too little: of two depth images that share a tenth of what they see, one
search may miss what the other one finds. Such a transform is refined in both directions, and little
that agrees is enough for a weak match if several planes are among it and nothing contradicts it.
What the other search found is then a rival like any other hypothesis. The searches themselves stay
independent.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

import numpy as np

from sceneprint.geometry.kernel import run_both
from sceneprint.geometry.registration.alignment import (
    Alignment,
    AlignmentParameters,
    FrameSamples,
    Search,
    align,
    align_guided,
    align_scans,
    are_scans,
    contradiction,
    frame_samples,
)
from sceneprint.geometry.registration.icp import (
    FINE,
    CovarianceParameters,
    RefinementParameters,
    pair_covariance,
    refine,
)
from sceneprint.geometry.registration.overlap import (
    OverlapParameters,
    PlaneAgreement,
    overlap_counts,
    plane_agreement,
    sample_points,
)
from sceneprint.geometry.registration.sequence_alignment import Matching
from sceneprint.geometry.rigid import (
    NO_UPS,
    Ups,
    inverse,
    inverses,
    nearest_rotation,
    pose_difference,
    rotation_angle,
    tilt_of,
)
from sceneprint.geometry.validation.acceptance import (
    AcceptanceParameters,
    AmbiguityParameters,
    Evidence,
    Mode,
    Rival,
    Status,
    Strength,
    belief,
    best_alternative,
    objection,
    sparse_evidence_suffices,
)
from sceneprint.types import Floats, Geometry, Sphere, kind_of

#: From which frame to which a transform was searched for.
Direction = Literal["query_to_match", "match_to_query"]
THERE: Direction = "query_to_match"
BACK: Direction = "match_to_query"
_NONE = np.empty((0, 4, 4))
#: Where `up` itself is wrong, the right transform is among those that it calls impossible.
_MORE_TILTED = (
    "a transform that tilts against `up` explains more: check the IMU and the axes of `up`"
)


@dataclass(frozen=True)
class ValidationParameters:
    """The numbers of every step."""

    minimum_patches: int = 10  #: of either frame
    n_hypotheses: int = 4  #: of each direction, beside what was found, that a map may confirm
    guided_m: float = 0.15  #: from a predicted transform to the one found there, at most
    guided_rad: float = math.radians(6.0)  #: and between their rotations
    acceptance: AcceptanceParameters = field(default_factory=AcceptanceParameters)
    rivals: AmbiguityParameters = field(default_factory=AmbiguityParameters)
    alignment: AlignmentParameters = field(default_factory=AlignmentParameters)
    agreement: OverlapParameters = field(default_factory=OverlapParameters)
    covariance: CovarianceParameters = field(default_factory=CovarianceParameters)


@dataclass(frozen=True, eq=False)
class PairValidation:
    """The result of aligning a query with a candidate match.

    Parameters
    ----------
    status : accepted, rejected, or ambiguous (a rival transform explains the frames as well, or
        what they share leaves a direction free)
    strength : of an accepted match: strong, or weak where a rival comes near, little agrees, or a
        frame has no viewpoint; else None
    reason : a short sentence
    T_match_query : (4, 4) query coordinates to the match's, x_match = T @ x_query; the best there
        is, whatever the status: halfway between the two directions, or where these disagree, the
        one that more speaks for; None where the frames gave no hypothesis at all
    residual_m, residual_rad : of the two directions composed, T_match_query T_query_match;
        infinite where there is none. Of an accepted match with `T_other`, or with one direction
        only, those of its two refinements
    overlap : share of both frames' points that agree under the transform, 0 to 1
    plane_overlap : the same with every plane counting as much as another, however large, 0 to 1:
        low where only a floor or a wall agrees
    violations : free-space violations, as a share of violations and of the inliers counted with
        them, 0 to 1; None where neither frame has a viewpoint: no evidence of free space
    inliers : points of both frames that agree under the transform
    ambiguity : share of both frames that agrees under the best rival that free space does not
        refute, every plane counting the same; 0 to 1. Rivals are looked for only where all else
        speaks for accepting; elsewhere it is 0
    T_rival : (4, 4) that rival, or None
    seed : of the random choices
    covariance : (6, 6) of T_match_query where it is accepted, else None; see `icp.py`
    around : whether both frames see all around their sensors, as spinning scanners do
    planes : how many distinct planes agree, the mean of both frames
    plane_violations : `violations` with every plane counting the same
    search : what proposed the transform: correspondences of patches, the plans of two scans, or
        the map's poses
    directions : of the search, in which the transform was found: both, or the one that found it
    T_other : (4, 4) where the two directions disagree, what the other one found; else None
    hypotheses : (n, 4, 4) T_match_query of the best that either direction refined, and of
        `T_rival`: what the frames may stand to each other, for the map to decide between
    ups : (3,) up in the query's and in the match's coordinates, as far as it was known
    tilt_rad : by how much the transform tilts the one up against the other; None where either is
        not known
    contradicts_up : the surfaces alone would be believed, but the transform tilts too much
    predicted : (4, 4) of a guided one, T_match_query that the map's poses gave; else None
    """

    status: Status
    strength: Strength | None
    reason: str
    T_match_query: Floats | None
    residual_m: float
    residual_rad: float
    overlap: float
    plane_overlap: float
    violations: float | None
    inliers: int
    ambiguity: float
    T_rival: Floats | None
    seed: int
    covariance: Floats | None = None
    around: bool = False
    planes: float = 0.0
    plane_violations: float = 0.0
    search: Search = "correspondences"
    directions: tuple[Direction, ...] = ()
    T_other: Floats | None = None
    hypotheses: Floats = field(default_factory=lambda: _NONE)
    ups: Ups = NO_UPS
    tilt_rad: float | None = None
    contradicts_up: bool = False
    predicted: Floats | None = None

    @property
    def guided(self) -> bool:
        """Whether other matches predicted the transform, so that it is no vote of its own."""
        return self.predicted is not None


def middle(a: Floats, b: Floats) -> Floats:
    """Return the transform halfway between two that are near each other: (4, 4)."""
    result = np.eye(4)
    result[:3, :3] = nearest_rotation(a[:3, :3] + b[:3, :3])
    result[:3, 3] = (a[:3, 3] + b[:3, 3]) / 2
    return result


def refined_at(
    query: Geometry, match: Geometry, T_match_query: Floats, p: RefinementParameters | None = None
) -> Floats | None:
    """Refine a transform in both directions, and return the middle of the two.

    What is left of the error when the start was the truth is the sensors' and the reference
    poses', not that of the search.

    Returns
    -------
    (4, 4) T_match_query, or None where the frames do not overlap there
    """
    p = p or FINE
    a, b = query.surface, match.surface
    there = refine(sample_points(a, p.stride), b.fitted, T_match_query, p, kind_of(a.camera))
    back = refine(
        sample_points(b, p.stride), a.fitted, inverse(T_match_query), p, kind_of(b.camera)
    )
    if there is None or back is None:
        return None
    return middle(there.T, inverse(back.T))


def validate(
    query: Geometry,
    match: Geometry,
    seed: int = 0,
    p: ValidationParameters | None = None,
    mode: Mode = "full",
    matching: Matching = "histograms",
    *,
    ups: Ups = NO_UPS,
    other_axes: bool = False,
) -> PairValidation:
    """Align a query with a candidate both ways, and decide: Sec. III-E.

    Parameters
    ----------
    query, match : geometry artifacts made with one model
    seed : of the random choices, 0 or more; the same seed gives the same answer
    p : see ValidationParameters
    mode : "full", or "paper": accept where the residual of the two directions is small, on no
        other evidence
    matching : what correspondences are found by
    ups : (3,) unit vectors, up in the query's and in the match's coordinates, where they are
        known: where both are, what tilts the one against the other is impossible. Of scans, one
        alone is of use as well
    other_axes : whether scanners may have stood otherwise than upright; of scans without `ups`

    Raises
    ------
    ValueError : the descriptors have different lengths, an unknown mode or matching, or a
        negative seed.
    """
    if mode not in ("full", "paper"):
        raise ValueError(f"mode {mode!r} is neither 'full' nor 'paper'")
    if matching not in ("histograms", "sequence"):
        raise ValueError(f"matching {matching!r} is neither 'histograms' nor 'sequence'")
    p = p or ValidationParameters()
    fewest = min(len(query.patches), len(match.patches))
    if fewest < p.minimum_patches:
        return _nothing(
            f"a frame has {fewest} patches, and {p.minimum_patches} are needed to tell places "
            "apart",
            seed, query, match, ups,
        )  # fmt: skip
    a, b = _samples(query, match, ups, p)
    numbers = p.alignment, p.agreement, matching
    there: Alignment | None
    back: Alignment | None
    if are_scans(query, match):
        rng = np.random.default_rng((seed, 0))
        aligned = align_scans(a, b, rng, *numbers, other_axes=other_axes)
        there, back = aligned or (None, None)
    else:
        there, back = run_both(
            lambda: align(a, b, np.random.default_rng((seed, 0)), *numbers),
            lambda: align(b, a, np.random.default_rng((seed, 1)), *numbers),
        )
    if there is None and back is None:
        why = "no correspondences agree on a transform that the surfaces bear out"
        if tilt_of(np.eye(4), ups) is not None:
            why += " without tilting against `up`"
        return _nothing(why, seed, query, match, ups)
    return _decided(a, b, there, back, seed, p, mode)


def _samples(
    query: Geometry, match: Geometry, ups: Ups, p: ValidationParameters
) -> tuple[FrameSamples, FrameSamples]:
    stride, planes = p.agreement.stride, p.rivals.planes
    return frame_samples(query, stride, planes, ups[0]), frame_samples(
        match, stride, planes, ups[1]
    )


def validate_guided(
    query: Geometry,
    match: Geometry,
    T_match_query: Floats,
    seed: int = 0,
    p: ValidationParameters | None = None,
    ups: Ups = NO_UPS,
) -> PairValidation | None:
    """Check a transform that other matches and the map's poses predict: Sec. III-E without search.

    Both directions are refined from it and must meet, near it, with the evidence that `validate`
    asks for. Neither other hypotheses nor rivals are looked for, so what is accepted makes a pose
    more precise, but is no evidence of its own for it.

    Parameters
    ----------
    query, match, seed, p, ups : see `validate`
    T_match_query : (4, 4) predicted

    Returns
    -------
    validation : accepted; or None where the frames are to be searched after all
    """
    p = p or ValidationParameters()
    if min(len(query.patches), len(match.patches)) < p.minimum_patches:
        return None
    a, b = _samples(query, match, ups, p)
    there, back = run_both(
        lambda: align_guided(a, b, T_match_query, p.alignment),
        lambda: align_guided(b, a, inverse(T_match_query), p.alignment),
    )
    if there is None or back is None:
        return None
    validation = _decided(a, b, there, back, seed, p, "full")
    if validation.status != "accepted" or validation.T_match_query is None:
        return None
    metres, radians = pose_difference(validation.T_match_query, T_match_query)
    if metres > p.guided_m or radians > p.guided_rad:
        return None
    reason = "surfaces agree where other matches place the query"
    return replace(validation, reason=reason, predicted=T_match_query)


def validate_without_up(
    query: Geometry,
    match: Geometry,
    seed: int,
    p: ValidationParameters | None,
    ups: Ups,
) -> PairValidation | None:
    """Ask the surfaces alone, of a query that found nothing with `up`: the check of `up`.

    A transform that they accept and that does not tilt counts as ever. One that is strong and
    tilts speaks against `up`, or is of a place that looks alike: it is rejected, and the reason
    says so.

    Parameters
    ----------
    query, match, seed, p : see `validate`
    ups : what was known of up

    Returns
    -------
    validation : or None where it adds nothing to what is known
    """
    p = p or ValidationParameters()
    validation = validate(query, match, seed, p)
    if validation.status != "accepted":
        return None
    validation = replace(validation, ups=ups, tilt_rad=tilt_of(validation.T_match_query, ups))
    gravity = p.alignment.gravity
    if validation.tilt_rad is None or validation.tilt_rad <= gravity.refined_tilt:
        return validation
    if validation.strength != "strong":
        return None
    why = contradiction(validation.tilt_rad, query, match, ups, gravity)
    return replace(
        validation,
        status="rejected",
        strength=None,
        reason=why,
        covariance=None,
        contradicts_up=True,
    )


def _nothing(reason: str, seed: int, query: Geometry, match: Geometry, ups: Ups) -> PairValidation:
    blind = query.surface.camera is None and match.surface.camera is None
    violations = None if blind else 0.0
    return PairValidation(
        "rejected", None, reason, None, math.inf, math.inf, 0.0, 0.0, violations, 0, 0.0, None,
        seed, ups=ups,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Proposal:
    """A transform that is judged.

    Parameters
    ----------
    T : (4, 4) T_match_query
    directions : of the search, in which it was found
    refined_by : the alignments that it is the middle of, or the one that it is of
    evidence, inliers : see Evidence and PairValidation
    """

    T: Floats
    directions: tuple[Direction, ...]
    refined_by: tuple[Alignment, ...]
    evidence: Evidence
    inliers: int

    def covariance(self, p: ValidationParameters) -> Floats | None:
        """Return the covariance (6, 6) of T, or None where it was not refined both ways.

        Where the two refinements settle apart, what they differ by is part of the error.
        """
        refined = [one.refined for one in self.refined_by]
        if len(refined) < 2 or refined[0] is None or refined[1] is None:
            return None
        covariance = pair_covariance(refined[0], refined[1], self.T, p.covariance)
        e, limits = self.evidence, p.acceptance
        if covariance is None:
            return None
        if e.residual_m > limits.residual_m or e.residual_rad > limits.residual_rad:
            off = _small_difference(refined[0].T, self.T)
            covariance = covariance + np.outer(off, off)
        return covariance


def _small_difference(a: Floats, b: Floats) -> Floats:
    """Return what must be added to b to give a: metres, then radians about the axes, (6,)."""
    D = a[:3, :3] @ b[:3, :3].T
    turn = [D[2, 1] - D[1, 2], D[0, 2] - D[2, 0], D[1, 0] - D[0, 1]]
    return np.concatenate([a[:3, 3] - b[:3, 3], np.array(turn) / 2])


class _Verdict(NamedTuple):
    """Status, strength and reason of a validation, and the rival that was found."""

    status: Status
    strength: Strength | None
    reason: str
    rival: Rival = Rival(0.0, None)


def _decided(
    query: FrameSamples, match: FrameSamples, there: Alignment | None, back: Alignment | None,
    seed: int, p: ValidationParameters, mode: Mode,
) -> PairValidation:  # fmt: skip
    residual, estimates = _estimates(there, back, p.acceptance)
    found_by = tuple(one for one in (there, back) if one is not None)
    transforms = list(estimates.values())
    seen = plane_agreement(query.planes, match.planes, np.stack(transforms), p.agreement)
    best = int(np.argmax(seen.share - p.alignment.rank_violations * seen.violations))
    (directions, T), *others = sorted(
        estimates.items(), key=lambda one: one[1] is not transforms[best]
    )
    evidence = _evidence(query, match, found_by, T, residual, seen, best, p)
    one = _Proposal(T, directions, found_by, *evidence)
    verdict = _verdict(query, match, one, there, back, p, mode)
    if verdict.status == "rejected" and mode == "full":
        sparse = _sparse(query, match, one, there, back, p)
        one, verdict = sparse or (one, verdict)
    e, rival, ups = one.evidence, verdict.rival, (query.up, match.up)
    covariance = one.covariance(p) if verdict.status == "accepted" else None
    return PairValidation(
        verdict.status, verdict.strength, verdict.reason, one.T, e.residual_m, e.residual_rad,
        e.overlap, e.plane_overlap, e.violations, one.inliers, rival.share, rival.T, seed,
        covariance, _sees_around(query.geometry) and _sees_around(match.geometry), e.planes,
        e.plane_violations, found_by[0].search, one.directions, others[0][1] if others else None,
        _hypotheses(there, back, transforms, rival.T, p.n_hypotheses), ups, tilt_of(one.T, ups),
    )  # fmt: skip


def _verdict(
    query: FrameSamples, match: FrameSamples, one: _Proposal,
    there: Alignment | None, back: Alignment | None, p: ValidationParameters, mode: Mode,
) -> _Verdict:  # fmt: skip
    """Judge a transform by the agreement of both directions, the evidence and its rivals."""
    e = one.evidence
    against = objection(e, p.acceptance, mode) or _tilted(tilt_of(one.T, (query.up, match.up)), p)
    if against is not None:
        return _Verdict(against[0], None, against[1])
    if mode == "paper":
        one_view = e.violations is None or e.one_sided
        return _Verdict("accepted", "weak" if one_view else "strong", "the two directions agree")
    if one.refined_by[0].search == "guided":
        return _Verdict(*belief(e, 0.0, p.acceptance))
    rival = _rival(query, match, one, there, back, p)
    status, strength, reason = belief(e, rival.share, p.acceptance)
    if status == "accepted" and rival.tilted > e.plane_overlap:
        return _Verdict("ambiguous", None, _MORE_TILTED, rival)
    return _Verdict(status, strength, reason, rival)


def _rival(
    query: FrameSamples, match: FrameSamples, one: _Proposal,
    there: Alignment | None, back: Alignment | None, p: ValidationParameters,
) -> Rival:  # fmt: skip
    """Return the best rival of a transform, among all that either direction refined."""
    voted = [_NONE]
    if there is not None:
        voted += [there.T[None], there.others]
    if back is not None:
        voted += [inverse(back.T)[None], inverses(back.others)]
    return best_alternative(
        query.planes, match.planes, one.T, one.evidence.plane_violations, np.concatenate(voted),
        there.proposed if there else _NONE, p.rivals, p.agreement,
        (query.up, match.up), p.alignment.gravity.rival_tilt,
    )  # fmt: skip


def _sparse(
    query: FrameSamples, match: FrameSamples, one: _Proposal,
    there: Alignment | None, back: Alignment | None, p: ValidationParameters,
) -> tuple[_Proposal, _Verdict] | None:  # fmt: skip
    """Accept a transform of depth images as weak, if the little that it shows speaks for it.

    What one search alone found is refined in both directions first. What the other search found
    is a rival then, as all other hypotheses are.

    Returns
    -------
    the transform and its verdict, or None where the rejection stands
    """
    if one.refined_by[0].search != "correspondences" or are_scans(query.geometry, match.geometry):
        return None
    alone = len(one.directions) < 2
    if alone:
        refined = _refined_both_ways(query, match, one, p)
        if refined is None:
            return None
        one = refined
    e, covariance = one.evidence, one.covariance(p)
    if covariance is None or _tilted(tilt_of(one.T, (query.up, match.up)), p) is not None:
        return None
    deviation = math.sqrt(max(float(np.trace(covariance[:3, :3])), 0.0))
    if not sparse_evidence_suffices(e, deviation, p.acceptance, alone=alone):
        return None
    rival = _rival(query, match, one, there, back, p)
    status, _, _ = belief(e, rival.share, p.acceptance)
    if status != "accepted" or rival.tilted > e.plane_overlap:
        return None
    reason = f"{e.overlap:.0%} of the surfaces agree, in {e.planes:.0f} planes"
    if alone:
        reason += ", but one direction alone found it"
    return one, _Verdict("accepted", "weak", reason, rival)


def _refined_both_ways(
    query: FrameSamples, match: FrameSamples, one: _Proposal, p: ValidationParameters
) -> _Proposal | None:
    """Refine in both directions what one search found, where it explains enough to be worth it."""
    e = one.evidence
    half = p.acceptance.sparse_plane_overlap / 2
    if e.plane_overlap - e.plane_violations < half or e.plane_violations > 2 * half:
        return None
    there = align_guided(query, match, one.T, p.alignment)
    back = align_guided(match, query, inverse(one.T), p.alignment)
    if there is None or back is None:
        return None
    residual, _ = _estimates(there, back, p.acceptance)
    T = middle(there.T, inverse(back.T))
    seen = plane_agreement(query.planes, match.planes, T[None], p.agreement)
    evidence = _evidence(query, match, (there, back), T, residual, seen, 0, p)
    return _Proposal(T, one.directions, (there, back), *evidence)


def _hypotheses(
    there: Alignment | None, back: Alignment | None, estimates: Sequence[Floats],
    T_rival: Floats | None, each: int,
) -> Floats:  # fmt: skip
    """Return the estimates, the rival, and the next best of each direction: (n, 4, 4)."""
    hypotheses = [*estimates] if T_rival is None else [*estimates, T_rival]
    if there is not None:
        hypotheses += [*there.others[:each]]
    if back is not None:
        hypotheses += [*inverses(back.others[:each])]
    return np.array(hypotheses)


def _tilted(tilt: float | None, p: ValidationParameters) -> tuple[Status, str] | None:
    """Reject a transform that the last refinement tilted more than the search allows."""
    if tilt is None or tilt <= p.alignment.gravity.refined_tilt:
        return None
    return "rejected", f"it tilts by {math.degrees(tilt):.0f} deg against `up`"


def _estimates(
    there: Alignment | None, back: Alignment | None, p: AcceptanceParameters
) -> tuple[tuple[float, float], dict[tuple[Direction, ...], Floats]]:
    """Return the residual of the two directions, and T_match_query by the directions that found it.

    Where the directions agree, the transform is halfway between them. Where they do not, each keeps
    its own, as halfway between two places is neither.
    """
    if there is not None and back is not None:
        composed = there.T @ back.T  # reading R5: the residual transform T_Q^X T_X^Q itself
        metres = float(np.linalg.norm(composed[:3, 3]))
        radians = rotation_angle(composed[:3, :3])
        if metres <= p.residual_m and radians <= p.residual_rad:
            return (metres, radians), {(THERE, BACK): middle(there.T, inverse(back.T))}
        return (metres, radians), {(THERE,): there.T, (BACK,): inverse(back.T)}
    by_direction: dict[tuple[Direction, ...], Floats] = {}
    if there is not None:
        by_direction[(THERE,)] = there.T
    if back is not None:
        by_direction[(BACK,)] = inverse(back.T)
    return (math.inf, math.inf), by_direction


def _sees_around(frame: Geometry) -> bool:
    camera = frame.surface.camera
    return isinstance(camera, Sphere) and camera.sees_around


def _evidence(
    query: FrameSamples, match: FrameSamples, found_by: Sequence[Alignment], T: Floats,
    residual: tuple[float, float], by_planes: PlaneAgreement, k: int, p: ValidationParameters,
) -> tuple[Evidence, int]:  # fmt: skip
    """Return the evidence for transform `k` of those explained, and how many points agree."""
    of_query = overlap_counts(query.points, match.geometry.surface, T, p.agreement)
    of_match = overlap_counts(match.points, query.geometry.surface, inverse(T), p.agreement)
    inliers = of_query.inliers + of_match.inliers
    seen = [one for one in (of_query, of_match) if one.violations is not None]
    violated = sum(one.violations or 0 for one in seen)
    agreeing = sum(one.inliers for one in seen)
    weights = sum(float(one.planes.weights.sum(dtype=float)) for one in (query, match))
    e = Evidence(
        *residual,
        overlap=inliers / max(of_query.points + of_match.points, 1),
        plane_overlap=float(by_planes.share[k]),
        violations=violated / max(agreeing + violated, 1) if seen else None,
        stiffness=min(one.stiffness for one in found_by),
        one_sided=len(seen) == 1,
        planes=float(by_planes.share[k]) * weights / 2,
        plane_violations=float(by_planes.violations[k]),
        worst_violations=max((one.violation_share for one in seen), default=0.0),
    )
    return e, inliers


# Association: which validated candidates to believe first.

#: Error of a depth camera's transform for each radian between the two views, metres: distortion
#: and reference poses that drift, of which the covariance of a refinement knows nothing.
_ERROR_PER_RADIAN = 0.04


def preferred(validations: Sequence[PairValidation]) -> list[int]:
    """Return the positions of accepted validations: strong before weak, each most precise first.

    The paper keeps the order of R. A weak match has a rival that explains the frames nearly as
    well, so a later strong one goes before it. Of cameras, that with the least expected error
    comes first. Where all frames see all around, the nearest sensor does.

    Parameters
    ----------
    validations : in the order of R
    """
    accepted = [i for i, v in enumerate(validations) if v.status == "accepted"]
    around = all(validations[i].around for i in accepted)

    def rank(i: int) -> tuple[bool, float]:
        validation = validations[i]
        off = _away(validation) if around else expected_error(validation)
        return validation.strength != "strong", off

    return sorted(accepted, key=rank)


def expected_error(validation: PairValidation) -> float:
    """Return by how many metres a transform between cameras is likely off.

    It is the deviation of the translation and an error that grows with the angle between the views,
    added in quadrature. It is infinite where the covariance is not known.
    """
    T, covariance = validation.T_match_query, validation.covariance
    if T is None or covariance is None:
        return math.inf
    variance = max(float(np.trace(covariance[:3, :3])), 0.0)
    return math.hypot(math.sqrt(variance), _ERROR_PER_RADIAN * rotation_angle(T[:3, :3]))


def _away(validation: PairValidation) -> float:
    """Return the distance between the two sensors, metres."""
    T = validation.T_match_query
    return 0.0 if T is None else float(np.linalg.norm(T[:3, 3]))
