"""Confidences of candidate poses: the probabilities that the poses are right.

    PlaceEvidence of all candidates  --compute_confidences-->  P(right) of each, sum <= 1
    PlaceEvidence  --weakest_evidence-->  clause on the evidence with the largest penalty

At most one of the candidates is right. The log odds of a candidate, relative to the case that all
are wrong, are the log odds of a pose with the best possible evidence, minus a penalty for each kind
of evidence. Penalties are piecewise linear functions that never increase with better evidence, so
more support cannot lower a confidence, and a better rival cannot raise it.
`sceneprint_lab.confidence` fits the penalties to synthetic places; docs/trust.md shows the
calibration on recordings.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class PlaceEvidence:
    """The evidence for and against a candidate pose of the query.

    Parameters
    ----------
    score : agreement with the map's frames, at most 1; see ScoredPose
    share : share of the query's surface that the map shows at the pose, with equal weights for all
        planes
    planes : number of distinct planes of the query that agree with the map
    frames : number of frames of the map that agree
    viewpoints : number of viewpoints of these frames
    excess : share of free-space violations of query and map, minus the share among the map's own
        frames
    weight : sum of the weights of the votes for the pose, one vote per viewpoint: 1 for a strong
        match, less for a weak or ambiguous match; see `LocalizationParameters`
    strong : number of viewpoints of strong matches that vote for the pose
    accepted : number of viewpoints of accepted matches, including guided matches, that lead to the
        pose
    suggested : number of viewpoints of candidates, accepted or not, that suggest the pose
    similarity : maximum similarity between the signatures of these candidates and the query's, 0 to
        1
    rival : score of the best other place, relative to the score of this place; 0 if there is no
        other
    rival_weight : largest `weight` of any other place
    distinctness : maximum over these candidates of the ratio of the correlation of two scans'
        points in height slices at the pose to that at any other; 0 if unknown
    rendered : whether most of the agreeing frames are views that were rendered from a surface
    """

    score: float
    share: float
    planes: float
    frames: int
    viewpoints: int
    excess: float
    weight: float
    strong: int
    accepted: int
    suggested: int
    similarity: float
    rival: float
    rival_weight: float
    distinctness: float = 0.0
    rendered: bool = False

    @property
    def acceptance(self) -> float:
        """Return the ratio of accepted matches to frames that see the place (at most 5 count).

        At most five matches are validated. At the right place, most of them are accepted if many
        frames see it; at a place that only looks similar, few are accepted.
        """
        return min(self.accepted / max(min(self.frames, 5), 1), 1.0)


@dataclass(frozen=True)
class Penalty:
    """The penalties of a kind of evidence at its knots; 0 at the best knot.

    Parameters
    ----------
    worst, poor, fair : penalties at the first, second and third knot, in descending order
    """

    worst: float = 0.0
    poor: float = 0.0
    fair: float = 0.0

    @property
    def values(self) -> tuple[float, float, float, float]:
        """Return the penalties at the four knots."""
        return self.worst, self.poor, self.fair, 0.0


#: Knots: four values of each kind of evidence, worst first; penalties are linear between them.
KNOTS: Mapping[str, tuple[float, float, float, float]] = {
    "score": (0.05, 0.15, 0.3, 0.6),
    "planes": (3.0, 6.0, 12.0, 24.0),
    "frames": (1.0, 3.0, 6.0, 10.0),
    "excess": (0.25, 0.12, 0.05, 0.0),
    "weight": (0.0, 0.4, 1.0, 3.0),
    "strong": (0.0, 1.0, 2.0, 4.0),
    "acceptance": (0.0, 0.2, 0.5, 1.0),
    "suggested": (0.0, 1.0, 2.0, 4.0),
    "similarity": (0.05, 0.2, 0.4, 0.65),
    "rival": (1.0, 0.8, 0.5, 0.2),
    "rival_weight": (2.0, 1.0, 0.4, 0.0),
    "distinctness": (0.0, 1.5, 2.0, 3.0),
}


@dataclass(frozen=True)
class ConfidenceParameters:
    """Parameters of confidences, fitted to synthetic places.

    Parameters
    ----------
    best : log odds of a pose with the best possible evidence of every kind
    score, planes, ... : penalty of each kind of evidence
    """

    best: float = 8.0
    score: Penalty = Penalty(4.0, 2.0, 0.5)
    planes: Penalty = Penalty(6.0, 3.0, 0.5)
    frames: Penalty = Penalty(1.0, 0.5, 0.2)
    excess: Penalty = Penalty(9.0, 5.0, 1.5)
    weight: Penalty = Penalty(2.0, 1.5, 1.0)
    strong: Penalty = Penalty(1.5, 0.5, 0.0)
    acceptance: Penalty = Penalty(2.0, 1.5, 0.5)
    suggested: Penalty = Penalty(1.0, 1.0, 0.0)
    similarity: Penalty = Penalty(0.0, 0.0, 0.0)
    rival: Penalty = Penalty(9.0, 5.0, 2.0)
    rival_weight: Penalty = Penalty(4.0, 2.0, 1.0)
    distinctness: Penalty = Penalty(0.0, 0.0, 0.0)


@dataclass(frozen=True)
class ConfidenceModel:
    """Parameters of confidences for each kind of map.

    Views that were rendered from a surface agree perfectly with each other, even if the surface is
    wrong, and have no violations among themselves. Therefore, violations by a real frame are weaker
    evidence on such maps, and other kinds of evidence have more weight.

    Parameters
    ----------
    frames : parameters for maps of a sensor's frames
    views : parameters for maps of views that were rendered from a surface
    """

    frames: ConfidenceParameters = field(default_factory=ConfidenceParameters)
    views: ConfidenceParameters = field(default_factory=ConfidenceParameters)

    def of(self, e: PlaceEvidence) -> ConfidenceParameters:
        """Return the parameters for a pose with this evidence."""
        return self.views if e.rendered else self.frames


def compute_penalties(e: PlaceEvidence, p: ConfidenceParameters) -> dict[str, float]:
    """Return the non-negative penalty of each kind of evidence, by name."""
    penalties = {}
    for name, knots in KNOTS.items():
        values = getattr(p, name).values
        rising = knots[0] < knots[-1]
        xs, ys = (knots, values) if rising else (knots[::-1], values[::-1])
        penalties[name] = float(np.interp(getattr(e, name), xs, ys))
    return penalties


def compute_confidences(evidence: Sequence[PlaceEvidence], p: ConfidenceModel) -> list[float]:
    """Return the probability that each candidate pose of a query is right.

    The probability that all are wrong is 1 minus their sum.

    Parameters
    ----------
    evidence : evidence for each candidate of a query; the candidates are at different places
    """
    odds = [math.exp(p.of(e).best - sum(compute_penalties(e, p.of(e)).values())) for e in evidence]
    total = 1.0 + sum(odds)
    return [ratio / total for ratio in odds]


def weakest_evidence(e: PlaceEvidence, p: ConfidenceModel) -> str:
    """Return a clause about the evidence that lowers the confidence of a pose most."""
    penalties = compute_penalties(e, p.of(e))
    name = max(penalties, key=penalties.__getitem__)
    return {
        "score": f"the map shows only {e.share:.0%} of the frame's surface",
        "planes": f"only {e.planes:.0f} distinct planes agree, and so few planes fit many places",
        "frames": "few frames of the map see this place",
        "excess": f"a pose fits, but {max(e.excess, 0.0):.0%} of the expected surface is missing: "
        "either another place looks similar, or this place has changed",
        "weight": "too few matches vote for the pose",
        "strong": "no strong match votes for the pose",
        "acceptance": f"few of the {e.frames} frames that see this place match the frame well",
        "suggested": f"only one of the {e.viewpoints} views of the place suggests this pose",
        "similarity": "the frame is not similar to the frames of the map that suggest this pose",
        "rival": "another pose explains the frame equally well: the place repeats or is symmetric",
        "rival_weight": "the matches disagree: some vote for another pose",
        "distinctness": "the points above the ground fit about as well elsewhere"
        if e.distinctness
        else "the points above the ground do not confirm this pose",
    }[name]
