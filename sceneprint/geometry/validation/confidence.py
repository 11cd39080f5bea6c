"""Confidence: the probability that a candidate pose is right, computed from its evidence.

    PlaceEvidence of every candidate  --confidences_of-->  P(right) of each, 1 at most together
    PlaceEvidence  --weakest_evidence-->  a sentence on what keeps it from being more

One of the candidates is right, or none. The logarithm of the odds of each, against none, is what a
pose with the best evidence has, less one penalty for each kind of evidence. A penalty is a
piecewise linear function of its evidence that never rises with better evidence, so more support
never lowers a confidence, and a better rival never raises one. `sceneprint_lab.confidence` learns
the penalties on synthetic places; docs/trust.md shows how well the confidences are calibrated on
recordings.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class PlaceEvidence:
    """The evidence for and against a pose of the query.

    Parameters
    ----------
    score : how well the map's frames bear the pose out, see ScoredPose; at most 1
    share : share of the query's surface that the map shows there, every plane counting the same
    planes : distinct planes of the query that agree with the map
    frames : frames of the map that agree
    viewpoints : different viewpoints of these frames
    excess : free-space violations of both sides, less those that the map's own frames show among
        themselves; a share
    weight : of the matches that vote for the pose, one for each viewpoint: 1 of a strong match,
        less of a weak or an ambiguous one
    strong : different viewpoints of strong matches that vote for it
    accepted : different viewpoints of accepted matches that lead to it, those that were guided by
        others among them
    suggested : different viewpoints of candidates that suggest it, whether accepted or not
    similarity : of the signatures of the query and the nearest of these candidates, 0 to 1
    rival : score of the best other place, relative to this one's; 0 where there is none
    rival_weight : largest weight of the votes for another place
    rendered : whether most of these frames are views rendered from one surface
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
    rendered: bool = False

    @property
    def acceptance(self) -> float:
        """Accepted matches for each frame that sees the place, of five at most: 0 to 1.

        Where many frames of the map see the right place, most of their matches are accepted, and no
        more than five are tried for; at a place that only looks alike few are.
        """
        return min(self.accepted / max(min(self.frames, 5), 1), 1.0)


@dataclass(frozen=True)
class Penalty:
    """The reduction of the log odds by one kind of evidence, at its knots; 0 at the best knot.

    Parameters
    ----------
    worst, poor, fair : at the first, second and third knot; none below the next
    """

    worst: float = 0.0
    poor: float = 0.0
    fair: float = 0.0

    @property
    def values(self) -> tuple[float, float, float, float]:
        """The penalties at the four knots."""
        return self.worst, self.poor, self.fair, 0.0


#: The four values of each kind of evidence between which its penalty is linear, the worst first.
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
}


@dataclass(frozen=True)
class ConfidenceParameters:
    """The numbers of the confidence, learnt on synthetic places.

    Parameters
    ----------
    best : logarithm of the odds of a pose with the best evidence of every kind
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


@dataclass(frozen=True)
class ConfidenceModel:
    """The numbers of the confidence, by what the map is made of.

    Views of one surface agree with each other perfectly, whatever is wrong with that surface: they
    show no violations among themselves that could be allowed for. So free space that a real frame
    violates says less there, and the other kinds of evidence have to say more.

    Parameters
    ----------
    frames : where the map has frames of a sensor
    views : where it has views rendered from a surface
    """

    frames: ConfidenceParameters = field(default_factory=ConfidenceParameters)
    views: ConfidenceParameters = field(default_factory=ConfidenceParameters)

    def of(self, e: PlaceEvidence) -> ConfidenceParameters:
        """Return the numbers for a pose."""
        return self.views if e.rendered else self.frames


def penalties_of(e: PlaceEvidence, p: ConfidenceParameters) -> dict[str, float]:
    """Return how much each kind of evidence reduces the log odds: >= 0, by name."""
    penalties = {}
    for name, knots in KNOTS.items():
        values = getattr(p, name).values
        rising = knots[0] < knots[-1]
        xs, ys = (knots, values) if rising else (knots[::-1], values[::-1])
        penalties[name] = float(np.interp(getattr(e, name), xs, ys))
    return penalties


def confidences_of(evidence: Sequence[PlaceEvidence], p: ConfidenceModel) -> list[float]:
    """Return the probability of each candidate pose of a query to be the right one.

    Parameters
    ----------
    evidence : of every candidate of one query, each of another place
    p : see ConfidenceModel

    Returns
    -------
    confidences : in the same order; 1 less their sum is the probability that none is right
    """
    odds = [math.exp(p.of(e).best - sum(penalties_of(e, p.of(e)).values())) for e in evidence]
    whole = 1.0 + sum(odds)
    return [one / whole for one in odds]


def weakest_evidence(e: PlaceEvidence, p: ConfidenceModel) -> str:
    """Return a sentence on the evidence that lowers the confidence of a pose most."""
    penalties = penalties_of(e, p.of(e))
    name = max(penalties, key=penalties.__getitem__)
    return {
        "score": f"the map shows only {e.share:.0%} of what the frame sees",
        "planes": f"only {e.planes:.0f} distinct planes agree, and a few planes fit in many places",
        "frames": "few frames of the map see this place",
        "excess": f"a pose fits, but {max(e.excess, 0.0):.0%} of what should be in sight there is "
        "missing: another place may look like this one, or this one has changed",
        "weight": "too few matches vote for the pose",
        "strong": "no strong match votes for the pose",
        "acceptance": f"few of the {e.frames} frames that see this place match the frame well",
        "suggested": f"one view alone suggests this pose, of {e.viewpoints} that see the place",
        "similarity": "the frame looks little like those of the map that suggest this pose",
        "rival": "another pose explains the frame as well: the place repeats, or has a symmetry",
        "rival_weight": "the matches disagree: some vote for another pose",
    }[name]
