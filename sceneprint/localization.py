"""Localization: the pose of a query, from its validated matches and the map's frames.

matches, poses, MapViews  --localize-->  PoseEstimate

Accepted matches vote with their poses. These poses, and further poses that candidates suggest, are
compared with the frames of the map that would see the same surfaces. A pose's confidence is the
probability that it is right, given this evidence. The confidences of all poses add up to at most 1.
The best pose is `found` if its confidence reaches the confidence that the query requires.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, Protocol

import numpy as np

from sceneprint.geometry.registration.icp import fuse_votes
from sceneprint.geometry.registration.overlap import OverlapParameters
from sceneprint.geometry.retrieval.ranking import Ranking
from sceneprint.geometry.rigid import PoseAverage, average_poses
from sceneprint.geometry.validation.acceptance import Strength
from sceneprint.geometry.validation.confidence import (
    PlaceEvidence,
    compute_confidences,
    weakest_evidence,
)
from sceneprint.geometry.validation.map_verification import (
    MapParameters,
    MapViews,
    looks_ahead,
    view_separations,
)
from sceneprint.geometry.validation.validation import PairValidation
from sceneprint.pipeline import PairMatch, unguided_validations
from sceneprint.places import (
    LocalizationParameters,
    Place,
    PosePrior,
    QueryFrame,
    ViewsOf,
    judge_places,
    model_parameters,
)
from sceneprint.types import Floats, Geometry

LocalizationStatus = Literal["found", "ambiguous", "not_found"]
#: Evidence that confirmed the answer: strong matches that vote for the pose; the map's frames, if
#: no match is strong; or the robot's prior, if neither suffices.
Verifier = Literal["matches", "map", "prior"]


@dataclass(frozen=True, eq=False)
class AlternativePose:
    """A possible pose of the query.

    Parameters
    ----------
    T : (4, 4) T_parent_query
    support : number of different viewpoints of the matches that vote for the pose
    confidence : probability that the pose is right; None without a map
    evidence : evidence for and against the pose; None without a map
    """

    T: Floats
    support: int
    confidence: float | None
    evidence: PlaceEvidence | None


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """The estimated pose of a query, and its confidence.

    Parameters
    ----------
    status : found, ambiguous, or not_found
    reason : short explanation of the status
    parent : parent frame of the poses
    average : T_parent_query, with the spread and number of agreeing votes; None unless found
    covariance : (6, 6) covariance of `average`, in the order of `pose_error`; None if a vote has no
        covariance
    strength : strength of the matches that vote for the answer; None unless found
    verified_by : evidence that confirmed the answer; None unless found
    alternatives : plausible poses, best first; if found, the answer only
    votes : number of accepted matches with a pose in the parent frame
    members : database rows of the matches that vote for the answer
    guided : number of guided matches among `members`
    places : all evaluated places
    """

    status: LocalizationStatus
    reason: str
    parent: str
    average: PoseAverage | None
    covariance: Floats | None
    strength: Strength | None
    verified_by: Verifier | None
    alternatives: tuple[AlternativePose, ...]
    votes: int = 0
    members: tuple[int, ...] = ()
    guided: int = 0
    places: tuple[Place, ...] = ()

    @property
    def confidence(self) -> float | None:
        """Return the probability that the best pose is right; None without a map."""
        return self.alternatives[0].confidence if self.alternatives else None

    @property
    def evidence(self) -> PlaceEvidence | None:
        """Return the evidence for and against the best pose; None without a map."""
        return self.alternatives[0].evidence if self.alternatives else None


def localize(
    frames: Sequence[QueryFrame],
    poses: Sequence[Floats] | Mapping[int, Floats],
    parents: Sequence[str] | Mapping[int, str] | None = None,
    views_of: ViewsOf | None = None,
    prior: PosePrior | None = None,
    p: LocalizationParameters | None = None,
    overlap_p: OverlapParameters | None = None,
) -> PoseEstimate | None:
    """Estimate the pose of a query from its matches and the frames of the map.

    Parameters
    ----------
    frames : one or more frames of the query
    poses : T_parent_sensor (4, 4) of all rows of the database, or of the matches' rows, by row
    parents : parent frame of each row; None for a single parent frame. Poses are compared only
        within one parent frame, that of the prior or of most matches
    views_of : see ViewsOf; with None, only the matches decide, without the map
    prior : pose that the robot expects; None if it has no expectation
    p : parameters; None selects the parameters of the artifacts' model

    Returns
    -------
    estimate : the result; None if no evidence suggests a pose
    """
    p = p or model_parameters(frames)
    parent, prior, places = judge_places(
        frames, poses, parents, views_of, prior, p, overlap_p or OverlapParameters()
    )
    if not places:
        return None
    blind = all(frame.geometry.surface.camera is None for frame in frames)
    estimate = _estimate_from_places(parent, places, prior, p, blind=blind)
    return replace(estimate, places=tuple(places))


class QueryDatabase(Protocol):
    """The frames that a query searches: those in the store of a service or of an evaluation."""

    def locate(self, frames: Sequence[QueryFrame]) -> PoseEstimate | None:
        """Return the pose of the last frame, estimated from all frames' matches; see `localize`."""

    def search(
        self, frame: int, validations: Mapping[int, PairValidation]
    ) -> Sequence[PairMatch] | None:
        """Validate a frame's candidates, without guidance by other matches.

        Parameters
        ----------
        frame : index of the frame
        validations : existing validations of candidates, by row, which are reused

        Returns
        -------
        matches : result of `associate`; None if the deadline has passed
        """

    def posed(self, rows: Sequence[int]) -> Mapping[int, PosedFrame]:
        """Return the frames of those rows that have a pose, by row."""

    def compare(self, rows: Sequence[int]) -> Sequence[PairMatch]:
        """Validate the last frame against `rows`, without guidance by other matches."""


def decide(
    frames: Sequence[QueryFrame], ranking: Ranking, database: QueryDatabase,
    p: LocalizationParameters,
) -> PoseEstimate | None:  # fmt: skip
    """Estimate the pose of a query's last frame, with all validations that may change it.

    If no pose is found and some matches were guided, their transforms are searched without
    guidance. Before a pose counts as found, similar frames of other places are compared; see
    `rival_rows`.

    Parameters
    ----------
    frames : frames of the query, with the matches of their candidates
    ranking : R of the last frame

    Returns
    -------
    estimate : the result; None if no evidence suggests a pose
    """
    of_candidates = [frame.matches for frame in frames]
    elsewhere: Sequence[PairMatch] = ()

    def locate() -> PoseEstimate | None:
        all_matches = [*of_candidates[:-1], [*of_candidates[-1], *elsewhere]]
        return database.locate(
            [replace(frame, matches=own) for frame, own in zip(frames, all_matches, strict=True)]
        )

    def settle() -> PoseEstimate | None:
        estimate = locate()
        if estimate is None or estimate.status == "found":
            return estimate
        again = [
            None if existing is None else database.search(number, existing)
            for number, existing in enumerate(map(unguided_validations, of_candidates))
        ]
        if not any(again):
            return estimate
        of_candidates[:] = [new or old for new, old in zip(again, of_candidates, strict=True)]
        return locate()

    estimate = settle()
    tried = {match.index for match in of_candidates[-1]}
    ahead = looks_ahead(frames[-1].geometry)
    rows = rival_rows(estimate, ranking, tried, database.posed, ahead, p)
    if rows:
        elsewhere = database.compare(rows)
    return settle() if elsewhere else estimate


def views_of_rows(
    matches: Sequence[PairMatch],
    poses: Sequence[Floats],
    open_geometry: Callable[[int], Geometry | None],
    parents: Sequence[str] | None = None,
    p: MapParameters | None = None,
    overlap_p: OverlapParameters | None = None,
    ahead: Sequence[bool] | None = None,
    rendered: Sequence[bool] | None = None,
) -> ViewsOf:
    """Return the `views_of` of `localize` for a map whose poses are in memory.

    Parameters
    ----------
    matches : matches of the query; poses are first compared with the rows of these matches
    poses : T_parent_sensor (4, 4) of every row
    open_geometry : function that returns the artifact of a row, or None
    parents : parent frames of all rows; None for a single parent frame
    ahead : whether the sensor of each row looks along z; None if all do
    rendered : whether each row is a view rendered from a surface; None if none is
    """

    def views_of(parent: str, at: Floats) -> MapViews:  # noqa: ARG001
        own = [i for i in range(len(poses)) if parents is None or parents[i] == parent]
        tried = {match.index for match in matches}
        return MapViews(
            np.array([poses[i] for i in own]).reshape(-1, 4, 4),
            lambda k: open_geometry(own[k]),
            p or MapParameters(),
            overlap_p or OverlapParameters(),
            [k for k, i in enumerate(own) if i in tried],
            None if ahead is None else [ahead[i] for i in own],
            None if rendered is None else [rendered[i] for i in own],
        )

    return views_of


@dataclass(frozen=True, eq=False)
class PosedFrame:
    """A frame of the map, its pose T_parent_sensor (4, 4), and whether its sensor looks along z."""

    parent: str
    T: Floats
    ahead: bool


def rival_rows(
    estimate: PoseEstimate | None,
    ranking: Ranking,
    tried: Collection[int],
    posed: Callable[[Sequence[int]], Mapping[int, PosedFrame]],
    query_ahead: bool,
    p: LocalizationParameters | None = None,
) -> list[int]:
    """Return database rows of similar frames whose places differ from that of the estimate.

    If two identical rooms were mapped from the same viewpoints, each signature is in the database
    twice, and all members of C may show the wrong room. Therefore, frames of other places whose
    signatures are about as near as those of the voting matches are validated too.

    Parameters
    ----------
    estimate : result of `localize`
    ranking : R
    tried : rows that were validated
    posed : function that returns the frames of the rows that have a pose, by row
    query_ahead : whether the query's sensor looks along z

    Returns
    -------
    rows : the first such rows of R, at most `p.rivals`; empty unless `estimate` was found by
        matches or the map
    """
    p = p or LocalizationParameters()
    if estimate is None or estimate.average is None or estimate.verified_by == "prior":
        return []
    if not p.rivals:
        return []
    order = ranking.indices.tolist()
    voting = [i for i, row in enumerate(order) if row in (estimate.members or tried)]
    if not voting:
        return []
    near = ranking.distances <= p.rival_distance * ranking.distances[voting[-1]]
    untried = [order[i] for i in np.flatnonzero(near) if order[i] not in tried]
    frames = {n: frame for n, frame in posed(untried).items() if frame.parent == estimate.parent}
    rows = [row for row in untried if row in frames]
    if not rows:
        return []
    poses = np.stack([frames[row].T for row in rows])
    ahead = np.array([frames[row].ahead for row in rows])
    apart = view_separations(poses, ahead, estimate.average.T, query_ahead, p.map)
    return [row for row, far in zip(rows, apart >= 1.0, strict=True) if far][: p.rivals]


def mark_unconfirmed(estimate: PoseEstimate) -> PoseEstimate:
    """Return a found estimate as ambiguous because similar frames elsewhere were not compared."""
    if estimate.average is None:
        return estimate
    return replace(
        estimate, status="ambiguous", average=None, covariance=None, strength=None,
        verified_by=None, members=(), guided=0,
        reason="the deadline passed before similar frames of other places were compared. Allow "
        "more time",
    )  # fmt: skip


def _estimate_from_places(
    parent: str, places: Sequence[Place], prior: PosePrior | None, p: LocalizationParameters, *,
    blind: bool = False,
) -> PoseEstimate:  # fmt: skip
    """Return the estimate that the evidence for all places gives.

    Parameters
    ----------
    parent, prior, places : result of `judge_places`, with at least one place
    blind : whether the free space of all query frames is unknown
    """
    if all(place.evidence is None for place in places):
        return _estimate_by_votes(parent, places, blind, p)
    confidences = _place_confidences(places, p)
    order = sorted(range(len(places)), key=lambda i: (-confidences[i], -places[i].score))
    best = places[order[0]]
    if confidences[order[0]] >= p.confidence:
        verified_by: Verifier = "matches" if best.strong else "map"
        return _found_estimate(parent, best, places, verified_by, confidences[order[0]], p)
    if prior is not None:
        inside = _confirm_by_prior(places, prior, p)
        if inside is not None:
            place, confidence = inside
            return _found_estimate(parent, place, places, "prior", confidence, p)
    worth = [i for i in order if confidences[i] >= p.worth][: p.views]
    alternatives = tuple(
        AlternativePose(places[i].T, places[i].support, confidences[i], places[i].evidence)
        for i in worth
    )
    reason = weakest_evidence(_known(best.evidence), p.judgement)
    votes = sum(len(place.accepted) for place in places)
    status: LocalizationStatus = "ambiguous" if alternatives else "not_found"
    return PoseEstimate(status, reason, parent, None, None, None, None, alternatives, votes)


def _known(evidence: PlaceEvidence | None) -> PlaceEvidence:
    assert evidence is not None
    return evidence


def _place_confidences(places: Sequence[Place], p: LocalizationParameters) -> list[float]:
    """Return the confidence of each place; 0 for places without votes if `p.voted_only`."""
    confidences = compute_confidences([_known(place.evidence) for place in places], p.judgement)
    return [
        0.0 if p.voted_only and not place.votes else confidence
        for place, confidence in zip(places, confidences, strict=True)
    ]


#: Minimum number of viewpoints that count as suggesting a pose that the prior expects.
_SUGGESTED_BY_PRIOR = 2


def _confirm_by_prior(
    places: Sequence[Place], prior: PosePrior, p: LocalizationParameters
) -> tuple[Place, float] | None:
    """Return the place that the prior confirms, and its confidence; None if there is none.

    Only places that the prior expects are rivals. The score of the confirmed place must also be at
    least `p.prior_share` of the best score of all places.
    """
    inside = [place for place in places if prior.expects(place.T)]
    most = max(place.score for place in places)
    within = []
    for place in inside:
        own, others = _known(place.evidence), [q for q in inside if q is not place]
        rival = max((other.score for other in others), default=0.0)
        evidence = replace(
            own, rival=rival / place.score if place.score > 0 else 1.0,
            rival_weight=max((other.weight for other in others), default=0.0),
            suggested=max(own.suggested, _SUGGESTED_BY_PRIOR),
        )  # fmt: skip
        within.append(replace(place, evidence=evidence))
    confidences = _place_confidences(within, p)
    best = max(range(len(within)), key=confidences.__getitem__, default=None)
    if best is None or within[best].score < p.prior_share * most:
        return None
    none = max(1.0 - sum(confidences), 0.0)
    confidence = p.prior_odds * confidences[best] / (p.prior_odds * sum(confidences) + none)
    return (within[best], confidence) if confidence >= p.confidence else None


def _estimate_by_votes(
    parent: str, places: Sequence[Place], blind: bool, p: LocalizationParameters
) -> PoseEstimate:
    """Return the estimate that the votes for places give, without a map."""
    order = sorted(places, key=lambda place: (not place.accepted, -place.weight))
    best, heaviest = order[0], max((place.weight for place in order[1:]), default=0.0)
    against = None
    if not best.accepted:
        against = "no match is accepted"
    elif heaviest * p.outweigh > best.weight:
        against = "the matches disagree: the best pose has less than twice the weight of the next"
    elif not best.strong and not blind:
        against = "the accepted matches are weak"
    if against is None:
        return _found_estimate(parent, best, places, "matches", None, p)
    alternatives = tuple(
        AlternativePose(place.T, place.support, None, None) for place in order[: p.views]
    )
    votes = sum(len(place.accepted) for place in places)
    return PoseEstimate("ambiguous", against, parent, None, None, None, None, alternatives, votes)


def _found_estimate(
    parent: str, place: Place, places: Sequence[Place], verified_by: Verifier,
    confidence: float | None, p: LocalizationParameters,
) -> PoseEstimate:  # fmt: skip
    """Return the `found` estimate for a place."""
    accepted = place.accepted
    votes = accepted[: p.views]
    covariances = [vote.covariance for vote in votes if vote.covariance is not None]
    average = average_poses(np.stack([vote.T for vote in votes] or [place.T]))
    covariance = None
    if votes and len(covariances) == len(votes):
        poses = np.stack([vote.T for vote in votes])
        inflations = 1.0 + np.array([vote.separation / p.half_weight for vote in votes]) ** 2
        average, covariance = fuse_votes(average, poses, np.stack(covariances), inflations)
    total = sum(len(each.accepted) for each in places)
    guided = sum(vote.match.validation.guided for vote in accepted)
    reason = _found_reason(average, len(accepted), guided, total, place.support, verified_by)
    strength: Strength = "strong" if place.strong else "weak"
    itself = AlternativePose(average.T, place.support, confidence, place.evidence)
    return PoseEstimate(
        "found", reason, parent, average, covariance, strength, verified_by, (itself,), total,
        tuple(vote.match.index for vote in accepted), guided,
    )  # fmt: skip


def _found_reason(
    average: PoseAverage, agreeing: int, guided: int, accepted: int, support: int,
    verified_by: Verifier,
) -> str:  # fmt: skip
    """Return a clause that describes the evidence for a found pose."""
    if verified_by == "map":
        return "the map's frames confirm this pose, and all other poses fit much worse"
    if verified_by == "prior":
        return "several poses fit, but only this pose agrees with the prior"
    if agreeing == 1:
        reason = "one match determines the pose"
        return reason if accepted == 1 else f"{reason}, and {accepted - 1} weaker matches disagree"
    spread = (
        f", within {average.spread_m:.2g} m and {math.degrees(average.spread_rad):.2g} deg"
        if average.support > 1
        else ""
    )
    reason = f"{agreeing} of {accepted} matches agree on the pose{spread}"
    if guided:
        reason += f", including {guided} guided by other matches"
    return f"{reason}, all from one viewpoint" if support == 1 else reason
