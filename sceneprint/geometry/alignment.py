"""Sec. III-E, one direction: two frames to the transform that explains them best, and to others.

Geometry, Geometry  --align-->  Alignment
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from sceneprint.geometry.agreement import AgreementParameters, agreements, sampled
from sceneprint.geometry.consensus import ConsensusParameters, consensus
from sceneprint.geometry.matching import MatchingParameters, correspondences
from sceneprint.geometry.projecting import kind_of
from sceneprint.geometry.registration import (
    COARSE,
    FINE,
    Refined,
    RefinementParameters,
    refine,
    refined_all,
)
from sceneprint.geometry.rigid import difference
from sceneprint.geometry.sequences import Matching, SequenceParameters, sequence_correspondences
from sceneprint.types import Floats, Floats32, Geometry, Surface


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
    agreement_p: AgreementParameters,
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
    p: AlignmentParameters, agreement_p: AgreementParameters,
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
