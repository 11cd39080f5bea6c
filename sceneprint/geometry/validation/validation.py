"""Sec. III-E, validation: two frames to a rigid transform, and whether to believe it.

    Geometry, Geometry, seed  --validate-->  Validation

The transform is estimated both ways, independently. That both agree is the paper's test. By
itself it believes too much: two estimates from the same two frames may fall into the same wrong
place, where plane lies on plane. So the transform must also explain what both sensors saw: enough
of both surfaces agrees, and next to nothing lies where the other frame saw through.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from sceneprint.geometry.pose.rigid import (
    difference,
    inverse,
    inverses,
    nearest_rotation,
    rotation_angle,
)
from sceneprint.geometry.surface.camera import kind_of
from sceneprint.geometry.validation.acceptance import (
    AcceptanceParameters,
    Evidence,
    Mode,
    Status,
    Strength,
    belief,
    objection,
)
from sceneprint.geometry.validation.ambiguity import AmbiguityParameters, best_alternative
from sceneprint.geometry.validation.consensus import ConsensusParameters, consensus
from sceneprint.geometry.validation.icp import (
    COARSE,
    FINE,
    CovarianceParameters,
    Refined,
    RefinementParameters,
    pair_covariance,
    refine,
    refined_all,
)
from sceneprint.geometry.validation.overlap import (
    OverlapParameters,
    agreements,
    explained,
    overlap_counts,
    plane_view,
    sampled,
)
from sceneprint.geometry.validation.patch_descriptors import MatchingParameters, correspondences
from sceneprint.geometry.validation.sequence_alignment import (
    Matching,
    SequenceParameters,
    sequence_correspondences,
)
from sceneprint.types import Floats, Floats32, Geometry, Sphere, Surface

# Sec. III-E, one direction: two frames to the transform that explains them best, and to others.
#
# Geometry, Geometry  --align-->  Alignment


@dataclass(frozen=True)
class AlignmentParameters:
    """The numbers of the search for a transform."""

    matching: MatchingParameters = field(default_factory=MatchingParameters)
    consensus: ConsensusParameters = field(default_factory=ConsensusParameters)
    n_refined: int = 8  #: hypotheses that are refined
    violation_weight: float = 3.0  #: of a violation beside an inlier, in the score
    same_m: float = 0.1  #: hypotheses this near are one
    same_rad: float = math.radians(6.0)
    coarse: RefinementParameters = COARSE
    fine: RefinementParameters = FINE
    lever: float = 1.0  #: in `stiffness` a radian counts as much as this many metres
    sequence: SequenceParameters = field(default_factory=SequenceParameters)


@dataclass(frozen=True, eq=False)
class Alignment:
    """One direction's outcome.

    Parameters
    ----------
    T : (4, 4) T_target_source
    others : (n, 4, 4) the other hypotheses that were refined, best first
    stiffness : least over largest eigenvalue of the information, 0 where a direction is free
    points : (N, 6) of the source that evidence is counted on
    refined : the last refinement, with its information; None where it was lost
    """

    T: Floats
    others: Floats
    stiffness: float
    points: Floats32
    refined: Refined | None


def align(
    source: Geometry,
    target: Geometry,
    rng: np.random.Generator,
    p: AlignmentParameters,
    agreement_p: OverlapParameters,
    matching: Matching = "histograms",
) -> Alignment | None:
    """The transform from source to target: Sec. III-E, in one direction.

    Correspondences vote for some forty hypotheses; these are scored by how the source's points fit
    the target's surface, the best distinct ones refined and scored again, and the best refined to
    the end.

    Parameters
    ----------
    source, target : geometry artifacts
    rng : of the patches drawn
    p, agreement_p : see there
    matching : what correspondences are found by

    Returns
    -------
    alignment : or None where no three correspondences agree, or no hypothesis survives refinement
    """
    if matching == "sequence":
        pairs = sequence_correspondences(source.patches, target.patches, rng, p.sequence)
    else:
        pairs = correspondences(source.descriptors, target.descriptors, rng, p.matching)
    hypotheses = consensus(source.patches, target.patches, pairs, p.consensus)
    points = sampled(source.surface, agreement_p.stride)
    if not len(hypotheses):
        return None
    scores = _scores(points, target.surface, hypotheses, p, agreement_p)
    chosen = _distinct(hypotheses, scores, p)
    refined = refined_all(source.surface, target.surface, hypotheses[chosen], p.coarse)
    if not len(refined):
        return None
    scores = _scores(points, target.surface, refined, p, agreement_p)
    order = np.argsort(-scores, kind="stable")
    best, others = refined[order[0]], refined[order[1:]]
    finely = sampled(source.surface, p.fine.stride)
    fine = refine(finely, target.surface, best, p.fine, kind_of(source.surface.camera))
    if fine is None:
        return Alignment(best, others, 0.0, points, None)
    scale = np.array([p.lever] * 3 + [1.0] * 3)
    eigenvalues = np.linalg.eigvalsh(fine.information / np.outer(scale, scale))
    stiffness = max(float(eigenvalues[0] / eigenvalues[-1]), 0.0)
    return Alignment(fine.T, others, stiffness, points, fine)


def _scores(
    points: Floats32, target: Surface, transforms: Floats,
    p: AlignmentParameters, agreement_p: OverlapParameters,
) -> Floats:  # fmt: skip
    counts = agreements(points, target, transforms, agreement_p)
    scores: Floats = counts[:, 0] - p.violation_weight * counts[:, 1]
    return scores


def _distinct(hypotheses: Floats, scores: Floats, p: AlignmentParameters) -> list[int]:
    """The best few that differ from each other."""
    chosen: list[int] = []
    for k in np.argsort(-scores, kind="stable"):
        far = True
        for c in chosen:
            metres, radians = difference(hypotheses[k], hypotheses[c])
            far = far and (metres > p.same_m or radians > p.same_rad)
        if far:
            chosen.append(int(k))
        if len(chosen) == p.n_refined:
            break
    return chosen


@dataclass(frozen=True)
class ValidationParameters:
    """The numbers of every step."""

    minimum_patches: int = 10  #: of either frame
    acceptance: AcceptanceParameters = field(default_factory=AcceptanceParameters)
    rivals: AmbiguityParameters = field(default_factory=AmbiguityParameters)
    alignment: AlignmentParameters = field(default_factory=AlignmentParameters)
    agreement: OverlapParameters = field(default_factory=OverlapParameters)
    covariance: CovarianceParameters = field(default_factory=CovarianceParameters)


@dataclass(frozen=True, eq=False)
class PairValidation:
    """What came of aligning a query with a candidate match.

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
        infinite where there is none
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
    covariance : (6, 6) of T_match_query where it is accepted, else None; see `covariance.py`
    around : whether both frames see all around their sensors, as spinning scanners do
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


def middle(a: Floats, b: Floats) -> Floats:
    """The transform halfway between two that are near each other: (4, 4)."""
    result = np.eye(4)
    result[:3, :3] = nearest_rotation(a[:3, :3] + b[:3, :3])
    result[:3, 3] = (a[:3, 3] + b[:3, 3]) / 2
    return result


def refined_at(
    query: Geometry, match: Geometry, T_match_query: Floats, p: RefinementParameters | None = None
) -> Floats | None:
    """Both directions refined from one given transform, and their middle.

    What is left of the error when the start was the truth is the sensors' and the reference
    poses', not that of the search.

    Returns
    -------
    (4, 4) T_match_query, or None where the frames do not overlap there
    """
    p = p or FINE
    a, b = query.surface, match.surface
    there = refine(sampled(a, p.stride), b, T_match_query, p, kind_of(a.camera))
    back = refine(sampled(b, p.stride), a, inverse(T_match_query), p, kind_of(b.camera))
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
) -> PairValidation:
    """Align a query with a candidate both ways, and decide: Sec. III-E.

    Parameters
    ----------
    query, match : geometry artifacts made with one model
    seed : of the random choices, 0 or more; the same seed gives the same answer
    p : see ValidationParameters
    mode : "full", or "paper": accept where the residual of the two directions is small, on no
        other evidence

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
            seed, query, match,
        )  # fmt: skip
    numbers = p.alignment, p.agreement, matching
    there = align(query, match, np.random.default_rng((seed, 0)), *numbers)
    back = align(match, query, np.random.default_rng((seed, 1)), *numbers)
    if there is None or back is None:
        why = "no correspondences agree on a transform that the surfaces bear out"
        return _nothing(why, seed, query, match)
    return _decided(query, match, there, back, seed, p, mode)


def _nothing(reason: str, seed: int, query: Geometry, match: Geometry) -> PairValidation:
    blind = query.surface.camera is None and match.surface.camera is None
    violations = None if blind else 0.0
    return PairValidation(
        "rejected", None, reason, None, math.inf, math.inf, 0.0, 0.0, violations, 0, 0.0, None, seed
    )


def _decided(
    query: Geometry, match: Geometry, there: Alignment, back: Alignment, seed: int,
    p: ValidationParameters, mode: Mode,
) -> PairValidation:  # fmt: skip
    composed = there.T @ back.T  # reading R5: the residual transform T_Q^X T_X^Q itself
    residual = float(np.linalg.norm(composed[:3, 3])), rotation_angle(composed[:3, :3])
    limits = p.acceptance.residual_m, p.acceptance.residual_rad
    found = [middle(there.T, inverse(back.T))]
    if residual[0] > limits[0] or residual[1] > limits[1]:
        found = [there.T, inverse(back.T)]  # halfway between two places is neither of them
    views = plane_view(query, p.rivals.planes), plane_view(match, p.rivals.planes)
    shares = explained(*views, np.stack(found), p.agreement).share
    told = [
        (*_evidence(query, match, there, back, T, residual, float(share), p), T)
        for T, share in zip(found, shares, strict=True)
    ]
    e, inliers, T = max(told, key=lambda one: one[0].total(p.acceptance))
    ambiguity, T_rival = 0.0, None
    strength: Strength | None = None
    against = objection(e, p.acceptance, mode)
    if against is not None:
        status, reason = against
    elif mode == "paper":
        strength = "weak" if e.violations is None or e.one_sided else "strong"
        status, reason = "accepted", "the two directions agree"
    else:
        voted = np.concatenate([there.others, inverses(back.others)])
        ambiguity, T_rival = best_alternative(*views, T, voted, p.rivals, p.agreement)
        status, strength, reason = belief(e, ambiguity, p.acceptance)
    covariance = None
    if status == "accepted":
        covariance = pair_covariance(there.refined, back.refined, T, p.covariance)
    return PairValidation(
        status, strength, reason, T, e.residual_m, e.residual_rad, e.overlap, e.plane_overlap,
        e.violations, inliers, ambiguity, T_rival, seed, covariance,
        _sees_around(query) and _sees_around(match),
    )  # fmt: skip


def _sees_around(frame: Geometry) -> bool:
    camera = frame.surface.camera
    return isinstance(camera, Sphere) and camera.sees_around


def _evidence(
    query: Geometry, match: Geometry, there: Alignment, back: Alignment, T: Floats,
    residual: tuple[float, float], plane_overlap: float, p: ValidationParameters,
) -> tuple[Evidence, int]:  # fmt: skip
    """What speaks for a transform and against it, and how many points agree under it."""
    of_query = overlap_counts(there.points, match.surface, T, p.agreement)
    of_match = overlap_counts(back.points, query.surface, inverse(T), p.agreement)
    inliers = of_query.inliers + of_match.inliers
    seen = [one for one in (of_query, of_match) if one.violations is not None]
    violated = sum(one.violations or 0 for one in seen)
    agreeing = sum(one.inliers for one in seen)
    e = Evidence(
        *residual,
        overlap=inliers / max(of_query.points + of_match.points, 1),
        plane_overlap=plane_overlap,
        violations=violated / max(agreeing + violated, 1) if seen else None,
        stiffness=min(there.stiffness, back.stiffness),
        one_sided=len(seen) == 1,
    )
    return e, inliers
