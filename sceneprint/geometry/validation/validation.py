"""Alignment of two frames by a rigid transform, and the decision to accept it (Sec. III-E).

    Geometry, Geometry, seed  --validate-->  PairValidation
    validations  --rank_accepted-->  C_vld

The paper estimates the transform in both directions independently, and accepts it if they agree.
This test accepts too much, because both estimates may converge to the same wrong place. Therefore,
the transform must also explain both frames: enough of both surfaces must agree, and almost no
points may lie in free space of the other frame.

It also accepts too little: if two depth images share only a tenth of their surfaces, the search in
one direction may miss the transform that the search in the other direction finds. Such a transform
is refined in both directions. Little agreement suffices for a weak match if several planes agree
and nothing contradicts the transform; the result of the other direction is then one of the rivals.
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
from sceneprint.geometry.registration.slice_support import measure_distinctness
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
    sliced_evidence_suffices,
    sparse_evidence_suffices,
)
from sceneprint.types import Floats, Geometry, Sphere, kind_of

#: Direction of a search.
Direction = Literal["query_to_match", "match_to_query"]
THERE: Direction = "query_to_match"
BACK: Direction = "match_to_query"
_NONE = np.empty((0, 4, 4))
#: Reason of a rejection if `up` excludes a transform that may be right, because `up` may be wrong.
_MORE_TILTED = (
    "a transform that tilts against `up` explains the frames better. Check the IMU and the axes of "
    "`up`"
)


@dataclass(frozen=True)
class ValidationParameters:
    """Parameters of all steps of a validation."""

    minimum_patches: int = 10  #: minimum number of patches of each frame
    n_hypotheses: int = 4  #: number of further hypotheses per direction, for verification in a map
    guided_m: float = 0.15  #: maximum distance of a guided transform from its prediction, metres
    guided_rad: float = math.radians(6.0)  #: maximum angle from its prediction, radians
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
    status : accepted, rejected, or, if a rival transform explains the frames equally well or a
        direction is unconstrained, ambiguous
    strength : strong; weak if a rival is close, little agrees, or a frame has no viewpoint; None
        unless the match is accepted
    reason : short explanation of the status
    T_match_query : (4, 4) best transform, regardless of the status: halfway between the two
        directions or, if they disagree, the direction with more evidence; None without any
        hypothesis
    residual_m, residual_rad : residual of T_match_query T_query_match, the composition of both
        directions; infinite if one is missing. For an accepted match with `T_other` or with a
        single direction, the residual between its two refinements
    overlap : share of both frames' points that agree under the transform, 0 to 1
    plane_overlap : overlap with equal weights for all planes, 0 to 1; it is low if only a floor or
        a wall agrees
    violations : free-space violations as a share of violations and inliers, 0 to 1; None if neither
        frame has a viewpoint
    inliers : number of points of both frames that agree under the transform
    ambiguity : share of both frames that agrees, with equal weights for all planes, under the best
        rival that free space does not refute, 0 to 1; 0 if the transform is rejected for other
        reasons
    T_rival : (4, 4) best rival; None without a rival
    seed : seed of the random choices
    covariance : (6, 6) covariance of T_match_query, see `icp.py`; None unless accepted
    around : whether both frames see all around their sensors, as spinning scanners do
    planes : number of distinct planes that agree, averaged over both frames
    plane_violations : `violations` with equal weights for all planes
    search : source of the transform: correspondences, plans of two scans, or the map's poses
    directions : directions of the search that found the transform
    T_other : (4, 4) result of the other direction if the two directions disagree; otherwise None
    hypotheses : (n, 4, 4) T_match_query of the best refined hypotheses of both directions and of
        `T_rival`, for verification in a map
    ups : (3,) unit vectors, up in the query's and in the match's coordinates; None if unknown
    tilt_rad : tilt of the transform against `ups`; None if either is unknown
    contradicts_up : whether the surfaces support the transform, but it tilts too much
    predicted : (4, 4) T_match_query that the map's poses predict; None unless the match is guided
    distinctness : ratio of the correlation of two scans' points in height slices under the
        transform to that under any other transform; 0 if unknown
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
    distinctness: float = 0.0

    @property
    def guided(self) -> bool:
        """Return whether other matches predicted the transform, so its vote is not independent."""
        return self.predicted is not None


def middle(a: Floats, b: Floats) -> Floats:
    """Return the transform halfway between two nearby transforms, (4, 4)."""
    result = np.eye(4)
    result[:3, :3] = nearest_rotation(a[:3, :3] + b[:3, :3])
    result[:3, 3] = (a[:3, 3] + b[:3, 3]) / 2
    return result


def refine_transform(
    query: Geometry, match: Geometry, T_match_query: Floats, p: RefinementParameters | None = None
) -> Floats | None:
    """Refine a transform in both directions; return the transform halfway between the results.

    If the initial transform is a reference, the change measures the errors of the sensors and of
    the reference poses.

    Returns
    -------
    (4, 4) T_match_query; None if the frames do not overlap under the initial transform
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
    """Align a query with a candidate in both directions, and decide on acceptance: Sec. III-E.

    If a frame has fewer than `p.minimum_patches` patches, or no transform is confirmed, the result
    is a rejection with its reason and without a transform.

    Parameters
    ----------
    query, match : geometry artifacts of one model
    seed : non-negative seed of the random choices; equal seeds give equal results
    mode : "full", or "paper" to accept or reject by the residual of the two directions only
    matching : method of matching
    ups : (3,) unit vectors that point up in the query's and in the match's coordinates; None if
        unknown. If both are known, transforms that tilt are excluded; scans use one of them too
    other_axes : for two scans with unknown `ups`, whether to try hypotheses for scanners that were
        not upright

    Raises
    ------
    ValueError : If the descriptors have different lengths, the mode or matching is unknown, or the
        seed is negative
    """
    if mode not in ("full", "paper"):
        raise ValueError(f"The mode {mode!r} does not exist. Pass 'full' or 'paper'.")
    if matching not in ("histograms", "sequence"):
        raise ValueError(
            f"The matching {matching!r} does not exist. Pass 'histograms' or 'sequence'."
        )
    p = p or ValidationParameters()
    fewest = min(len(query.patches), len(match.patches))
    if fewest < p.minimum_patches:
        reason = f"a frame has {fewest} patches, but validation requires {p.minimum_patches}"
        return _reject(reason, seed, query, match, ups)
    a, b = _prepare_samples(query, match, ups, p)
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
        reason = "the correspondences yield no transform that the surfaces confirm"
        if tilt_of(np.eye(4), ups) is not None:
            reason += " without tilting against `up`"
        return _reject(reason, seed, query, match, ups)
    return _decide(a, b, there, back, seed, p, mode)


def _prepare_samples(
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
    """Check a transform that other matches and the map's poses predict: Sec. III-E, without search.

    The prediction is refined in both directions. The results must agree, be near the prediction,
    and have the evidence that `validate` requires. There is no search for hypotheses or rivals, so
    an accepted transform makes a pose more precise, but is no evidence for it.

    Parameters
    ----------
    query, match, seed, p, ups : arguments of `validate`
    T_match_query : (4, 4) predicted transform

    Returns
    -------
    validation : an accepted match; None if the pair requires a search
    """
    p = p or ValidationParameters()
    if min(len(query.patches), len(match.patches)) < p.minimum_patches:
        return None
    a, b = _prepare_samples(query, match, ups, p)
    there, back = run_both(
        lambda: align_guided(a, b, T_match_query, p.alignment),
        lambda: align_guided(b, a, inverse(T_match_query), p.alignment),
    )
    if there is None or back is None:
        return None
    validation = _decide(a, b, there, back, seed, p, "full")
    if validation.status != "accepted" or validation.T_match_query is None:
        return None
    metres, radians = pose_difference(validation.T_match_query, T_match_query)
    if metres > p.guided_m or radians > p.guided_rad:
        return None
    reason = "the surfaces agree at the pose that other matches predict"
    return replace(validation, reason=reason, predicted=T_match_query)


def validate_without_up(
    query: Geometry,
    match: Geometry,
    seed: int,
    p: ValidationParameters | None,
    ups: Ups,
) -> PairValidation | None:
    """Validate by the surfaces only, to check `up` after a query without matches.

    An accepted transform that does not tilt is a match. A strong transform that tilts indicates a
    wrong `up` or a similar place; it is rejected for this reason.

    Parameters
    ----------
    query, match, seed, p : arguments of `validate`
    ups : up vectors of query and match, both known

    Returns
    -------
    validation : the result; None if it adds no information
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


def _reject(reason: str, seed: int, query: Geometry, match: Geometry, ups: Ups) -> PairValidation:
    blind = query.surface.camera is None and match.surface.camera is None
    violations = None if blind else 0.0
    return PairValidation(
        "rejected", None, reason, None, math.inf, math.inf, 0.0, 0.0, violations, 0, 0.0, None,
        seed, ups=ups,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Proposal:
    """A transform under evaluation.

    Parameters
    ----------
    T : (4, 4) T_match_query
    directions : directions of the search that found T
    refined_by : one alignment, or two alignments with T halfway between them
    evidence, inliers : see Evidence and PairValidation
    """

    T: Floats
    directions: tuple[Direction, ...]
    refined_by: tuple[Alignment, ...]
    evidence: Evidence
    inliers: int

    def covariance(self, p: ValidationParameters) -> Floats | None:
        """Return the covariance (6, 6) of T; None if it was not refined in both directions.

        The covariance includes the difference between the two refinements.
        """
        refined = [alignment.refined for alignment in self.refined_by]
        if len(refined) < 2 or refined[0] is None or refined[1] is None:
            return None
        covariance = pair_covariance(refined[0], refined[1], self.T, p.covariance)
        e, limits = self.evidence, p.acceptance
        if covariance is None:
            return None
        if e.residual_m > limits.residual_m or e.residual_rad > limits.residual_rad:
            shift = refined[0].T[:3, 3] - self.T[:3, 3]
            D = refined[0].T[:3, :3] @ self.T[:3, :3].T
            turn = [D[2, 1] - D[1, 2], D[0, 2] - D[2, 0], D[1, 0] - D[0, 1]]
            error = np.concatenate([shift, np.array(turn) / 2])
            covariance = covariance + np.outer(error, error)
        return covariance


class _Verdict(NamedTuple):
    """The status, strength and reason of a validation, and the best rival."""

    status: Status
    strength: Strength | None
    reason: str
    rival: Rival = Rival(0.0, None)


def _decide(
    query: FrameSamples, match: FrameSamples, there: Alignment | None, back: Alignment | None,
    seed: int, p: ValidationParameters, mode: Mode,
) -> PairValidation:  # fmt: skip
    residual, estimates = _combine_directions(there, back, p.acceptance)
    found_by = tuple(alignment for alignment in (there, back) if alignment is not None)
    transforms = list(estimates.values())
    seen = plane_agreement(query.planes, match.planes, np.stack(transforms), p.agreement)
    best = int(np.argmax(seen.share - p.alignment.rank_violations * seen.violations))
    (directions, T), *others = sorted(
        estimates.items(), key=lambda item: item[1] is not transforms[best]
    )
    evidence = _collect_evidence(query, match, found_by, T, residual, seen, best, p)
    proposal = _Proposal(T, directions, found_by, *evidence)
    distinctness = 0.0 if there is None else there.distinctness
    around = _sees_around(query.geometry) and _sees_around(match.geometry)
    is_partial = mode == "full" and not around and are_scans(query.geometry, match.geometry)
    if is_partial and proposal.evidence.planes >= p.acceptance.sliced_planes:
        plans = query.plan(p.alignment.plan), match.plan(p.alignment.plan)
        distinctness = measure_distinctness(*plans, T, p.alignment.plan)
    verdict = _judge(query, match, proposal, there, back, p, mode)
    if verdict.status == "rejected" and mode == "full":
        sparse = _accept_sparse(query, match, proposal, there, back, p)
        proposal, verdict = sparse or (proposal, verdict)
        if distinctness >= p.alignment.plan.slice_margin:
            verdict = _accept_sliced(proposal, (query.up, match.up), p) or verdict
    e, rival, ups = proposal.evidence, verdict.rival, (query.up, match.up)
    covariance = proposal.covariance(p) if verdict.status == "accepted" else None
    return PairValidation(
        verdict.status, verdict.strength, verdict.reason, proposal.T, e.residual_m, e.residual_rad,
        e.overlap, e.plane_overlap, e.violations, proposal.inliers, rival.share, rival.T, seed,
        covariance, around, e.planes, e.plane_violations, found_by[0].search, proposal.directions,
        others[0][1] if others else None,
        _collect_hypotheses(there, back, transforms, rival.T, p.n_hypotheses),
        ups, tilt_of(proposal.T, ups), distinctness=distinctness,
    )  # fmt: skip


def _judge(
    query: FrameSamples, match: FrameSamples, proposal: _Proposal,
    there: Alignment | None, back: Alignment | None, p: ValidationParameters, mode: Mode,
) -> _Verdict:  # fmt: skip
    """Decide on a transform by the agreement of the directions, the evidence and the rivals."""
    e = proposal.evidence
    against = objection(e, p.acceptance, mode) or _tilt_objection(
        tilt_of(proposal.T, (query.up, match.up)), p
    )
    if against is not None:
        return _Verdict(against[0], None, against[1])
    if mode == "paper":
        one_view = e.violations is None or e.one_sided
        return _Verdict("accepted", "weak" if one_view else "strong", "the two directions agree")
    if proposal.refined_by[0].search == "guided":
        return _Verdict(*belief(e, 0.0, p.acceptance))
    rival = _find_rival(query, match, proposal, there, back, p)
    status, strength, reason = belief(e, rival.share, p.acceptance)
    if status == "accepted" and rival.tilted > e.plane_overlap:
        return _Verdict("ambiguous", None, _MORE_TILTED, rival)
    return _Verdict(status, strength, reason, rival)


def _find_rival(
    query: FrameSamples, match: FrameSamples, proposal: _Proposal,
    there: Alignment | None, back: Alignment | None, p: ValidationParameters,
) -> Rival:  # fmt: skip
    """Search for the best rival of a transform; see `best_alternative`."""
    voted = [_NONE]
    if there is not None:
        voted += [there.T[None], there.others]
    if back is not None:
        voted += [inverse(back.T)[None], inverses(back.others)]
    return best_alternative(
        query.planes, match.planes, proposal.T, proposal.evidence.plane_violations,
        np.concatenate(voted), there.proposed if there else _NONE, p.rivals, p.agreement,
        (query.up, match.up), p.alignment.gravity.rival_tilt,
    )  # fmt: skip


def _accept_sparse(
    query: FrameSamples, match: FrameSamples, proposal: _Proposal,
    there: Alignment | None, back: Alignment | None, p: ValidationParameters,
) -> tuple[_Proposal, _Verdict] | None:  # fmt: skip
    """Accept a transform between depth images as weak if its evidence is sparse but consistent.

    If only one search found the transform, it is first refined in both directions, and the result
    of the other search is a rival.

    Returns
    -------
    the (refined) transform and its verdict; None if the rejection stands
    """
    if proposal.refined_by[0].search != "correspondences" or are_scans(
        query.geometry, match.geometry
    ):
        return None
    alone = len(proposal.directions) < 2
    if alone:
        refined = _refine_proposal(query, match, proposal, p)
        if refined is None:
            return None
        proposal = refined
    e, covariance = proposal.evidence, proposal.covariance(p)
    tilt = tilt_of(proposal.T, (query.up, match.up))
    if covariance is None or _tilt_objection(tilt, p) is not None:
        return None
    deviation = math.sqrt(max(float(np.trace(covariance[:3, :3])), 0.0))
    if not sparse_evidence_suffices(e, deviation, p.acceptance, alone=alone):
        return None
    rival = _find_rival(query, match, proposal, there, back, p)
    status, _, _ = belief(e, rival.share, p.acceptance)
    if status != "accepted" or rival.tilted > e.plane_overlap:
        return None
    reason = f"{e.overlap:.0%} of the surfaces agree, in {e.planes:.0f} planes"
    if alone:
        reason += ", but only one direction found it"
    return proposal, _Verdict("accepted", "weak", reason, rival)


def _accept_sliced(proposal: _Proposal, ups: Ups, p: ValidationParameters) -> _Verdict | None:
    """Accept a transform between scans as weak if height slices support it; None if they do not."""
    e = proposal.evidence
    if not sliced_evidence_suffices(e, p.acceptance) or _tilt_objection(
        tilt_of(proposal.T, ups), p
    ):
        return None
    reason = f"{e.overlap:.0%} of the surfaces agree, and the points above the ground fit best here"
    return _Verdict("accepted", "weak", reason)


def _refine_proposal(
    query: FrameSamples, match: FrameSamples, proposal: _Proposal, p: ValidationParameters
) -> _Proposal | None:
    """Refine the result of a single search in both directions; None if it explains too little."""
    e = proposal.evidence
    half = p.acceptance.sparse_plane_overlap / 2
    if e.plane_overlap - e.plane_violations < half or e.plane_violations > 2 * half:
        return None
    there = align_guided(query, match, proposal.T, p.alignment)
    back = align_guided(match, query, inverse(proposal.T), p.alignment)
    if there is None or back is None:
        return None
    residual, _ = _combine_directions(there, back, p.acceptance)
    T = middle(there.T, inverse(back.T))
    agreement = plane_agreement(query.planes, match.planes, T[None], p.agreement)
    evidence = _collect_evidence(query, match, (there, back), T, residual, agreement, 0, p)
    return _Proposal(T, proposal.directions, (there, back), *evidence)


def _collect_hypotheses(
    there: Alignment | None, back: Alignment | None, estimates: Sequence[Floats],
    T_rival: Floats | None, each: int,
) -> Floats:  # fmt: skip
    """Return the estimates, the rival, and the next `each` hypotheses per direction, (n, 4, 4)."""
    hypotheses = [*estimates] if T_rival is None else [*estimates, T_rival]
    if there is not None:
        hypotheses += [*there.others[:each]]
    if back is not None:
        hypotheses += [*inverses(back.others[:each])]
    return np.array(hypotheses)


def _tilt_objection(tilt: float | None, p: ValidationParameters) -> tuple[Status, str] | None:
    """Return a rejection if a transform tilts more than the search allows, otherwise None."""
    if tilt is None or tilt <= p.alignment.gravity.refined_tilt:
        return None
    return "rejected", f"it tilts by {math.degrees(tilt):.0f} deg against `up`"


def _combine_directions(
    there: Alignment | None, back: Alignment | None, p: AcceptanceParameters
) -> tuple[tuple[float, float], dict[tuple[Direction, ...], Floats]]:
    """Return the residual of the two directions, and each T_match_query with its directions as key.

    If the directions agree, there is a single transform, halfway between theirs; otherwise, each
    direction has its own.
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


def _collect_evidence(
    query: FrameSamples, match: FrameSamples, found_by: Sequence[Alignment], T: Floats,
    residual: tuple[float, float], by_planes: PlaneAgreement, k: int, p: ValidationParameters,
) -> tuple[Evidence, int]:  # fmt: skip
    """Return the evidence for transform `k` of `by_planes`, and the number of agreeing points."""
    there = overlap_counts(query.points, match.geometry.surface, T, p.agreement)
    back = overlap_counts(match.points, query.geometry.surface, inverse(T), p.agreement)
    inliers = there.inliers + back.inliers
    viewed = [counts for counts in (there, back) if counts.violations is not None]
    violated = sum(counts.violations or 0 for counts in viewed)
    agreeing = sum(counts.inliers for counts in viewed)
    weights = sum(float(frame.planes.weights.sum(dtype=float)) for frame in (query, match))
    e = Evidence(
        *residual,
        overlap=inliers / max(there.points + back.points, 1),
        plane_overlap=float(by_planes.share[k]),
        violations=violated / max(agreeing + violated, 1) if viewed else None,
        stiffness=min(alignment.stiffness for alignment in found_by),
        one_sided=len(viewed) == 1,
        planes=float(by_planes.share[k]) * weights / 2,
        plane_violations=float(by_planes.violations[k]),
        worst_violations=max((counts.violation_share for counts in viewed), default=0.0),
    )
    return e, inliers


#: Error of a depth camera's transform per radian between the two views, metres. It is caused by
#: distortion and by drift of reference poses, which the covariance of a refinement does not
#: include.
_ERROR_PER_RADIAN = 0.04


def rank_accepted(validations: Sequence[PairValidation]) -> list[int]:
    """Return the indices of accepted validations, strong before weak, most precise first.

    The paper preserves the order of R. A weak match may have a rival that explains the frames
    nearly as well, so strong matches precede it. Matches between cameras are ranked by expected
    error, and matches between frames that see all around by the distance between their sensors.

    Parameters
    ----------
    validations : validations of the frames in the order of R
    """
    accepted = [i for i, v in enumerate(validations) if v.status == "accepted"]
    around = all(validations[i].around for i in accepted)

    def rank(i: int) -> tuple[bool, float]:
        validation = validations[i]
        if not around:
            return validation.strength != "strong", expected_error(validation)
        T = validation.T_match_query
        distance = 0.0 if T is None else float(np.linalg.norm(T[:3, 3]))
        return validation.strength != "strong", distance

    return sorted(accepted, key=rank)


def expected_error(validation: PairValidation) -> float:
    """Return the expected error of a transform between two cameras, metres; infinite if unknown.

    It is the quadrature sum of the translation's standard deviation and an error that grows with
    the angle between the views.
    """
    T, covariance = validation.T_match_query, validation.covariance
    if T is None or covariance is None:
        return math.inf
    variance = max(float(np.trace(covariance[:3, :3])), 0.0)
    return math.hypot(math.sqrt(variance), _ERROR_PER_RADIAN * rotation_angle(T[:3, :3]))
