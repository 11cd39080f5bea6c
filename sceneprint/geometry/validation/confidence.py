"""Compute the confidence of a candidate pose: the probability that it is right.

    PlaceEvidence of every candidate  --compute_confidences-->  P(right) of each, sum <= 1
    PlaceEvidence  --weakest_evidence-->  sentence on the evidence that lowers it most

At most one of the candidates is right. The log odds of each, against none, are those of a pose with
the best evidence, less one penalty per kind of evidence. A penalty is a piecewise linear function
that never rises with better evidence, so more support never lowers a confidence, and a better rival
never raises one. `sceneprint_lab.confidence` learns the penalties on synthetic places;
docs/trust.md shows the calibration on recordings.
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
    score : agreement with the map's frames, see ScoredPose; at most 1
    share : share of the query's surface that the map shows there, all planes weighing the same
    planes : number of distinct planes of the query that agree with the map
    frames : number of frames of the map that agree
    viewpoints : number of their viewpoints
    excess : share of free-space violations of both sides, less that of the map's own frames among
        themselves
    weight : sum of the weights of votes for the pose, one per viewpoint: 1 for a strong match, less
        for a weak or an ambiguous one
    strong : number of viewpoints of strong matches that vote for it
    accepted : number of viewpoints of accepted matches that lead to it, guided ones included
    suggested : number of viewpoints of candidates that suggest it, accepted or not
    similarity : similarity of the signatures of the query and the nearest of these candidates, 0 to
        1
    rival : score of the best other place relative to this one's; 0 if there is none
    rival_weight : greatest weight of the votes for another place
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
        """Return the accepted matches per frame that sees the place, of at most five: 0 to 1.

        If many frames see the right place, most of their matches are accepted, and at most five are
        tried; at a place that only looks alike few are accepted.
        """
        return min(self.accepted / max(min(self.frames, 5), 1), 1.0)


@dataclass(frozen=True)
class Penalty:
    """The reduction of the log odds by one kind of evidence, at its knots; 0 at the best knot.

    Parameters
    ----------
    worst, poor, fair : penalties at the first, second and third knot, in falling order
    """

    worst: float = 0.0
    poor: float = 0.0
    fair: float = 0.0

    @property
    def values(self) -> tuple[float, float, float, float]:
        """Return the penalties at the four knots."""
        return self.worst, self.poor, self.fair, 0.0


#: Four values of each kind of evidence, worst first; its penalty is linear between them.
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
    """Parameters of the confidence, learnt on synthetic places.

    Parameters
    ----------
    best : log odds of a pose with the best evidence of every kind
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
    """Parameters of the confidence, by the kind of map.

    Views of one surface agree perfectly with each other, even if the surface is wrong, and show no
    violations among themselves. So a real frame's violations are weaker evidence there, and other
    kinds count more.

    Parameters
    ----------
    frames : for maps of a sensor's frames
    views : for maps of views rendered from a surface
    """

    frames: ConfidenceParameters = field(default_factory=ConfidenceParameters)
    views: ConfidenceParameters = field(default_factory=ConfidenceParameters)

    def of(self, e: PlaceEvidence) -> ConfidenceParameters:
        """Return the parameters for a pose."""
        return self.views if e.rendered else self.frames


def compute_penalties(e: PlaceEvidence, p: ConfidenceParameters) -> dict[str, float]:
    """Return the reduction of the log odds by each kind of evidence, >= 0, by name."""
    penalties = {}
    for name, knots in KNOTS.items():
        values = getattr(p, name).values
        rising = knots[0] < knots[-1]
        xs, ys = (knots, values) if rising else (knots[::-1], values[::-1])
        penalties[name] = float(np.interp(getattr(e, name), xs, ys))
    return penalties


def compute_confidences(evidence: Sequence[PlaceEvidence], p: ConfidenceModel) -> list[float]:
    """Return the probability that each candidate pose of a query is right, in the same order.

    1 minus their sum is the probability that none is right.

    Parameters
    ----------
    evidence : evidence of all candidates of one query, each at another place
    """
    odds = [math.exp(p.of(e).best - sum(compute_penalties(e, p.of(e)).values())) for e in evidence]
    total = 1.0 + sum(odds)
    return [each / total for each in odds]


def weakest_evidence(e: PlaceEvidence, p: ConfidenceModel) -> str:
    """Return a sentence on the evidence that lowers the confidence of a pose most."""
    penalties = compute_penalties(e, p.of(e))
    name = max(penalties, key=penalties.__getitem__)
    return {
        "score": f"the map shows only {e.share:.0%} of the frame's surface",
        "planes": f"only {e.planes:.0f} distinct planes agree, and a few planes fit in many places",
        "frames": "few frames of the map see this place",
        "excess": f"a pose fits, but {max(e.excess, 0.0):.0%} of the surface in view there is "
        "missing: another place may look like this one, or this one has changed",
        "weight": "too few matches vote for the pose",
        "strong": "no strong match votes for the pose",
        "acceptance": f"few of the {e.frames} frames that see this place match the frame well",
        "suggested": f"one view alone suggests this pose, of {e.viewpoints} that see the place",
        "similarity": "the frame looks little like those of the map that suggest this pose",
        "rival": "another pose explains the frame as well: the place repeats, or has a symmetry",
        "rival_weight": "the matches disagree: some vote for another pose",
    }[name]
