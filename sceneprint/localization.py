"""Validated matches to where the query was taken: found, ambiguous, or not found.

matches, poses, MapViews  --localize-->  PoseEstimate

Accepted matches vote with their poses. These poses, and all others that candidates suggest, are
judged on the frames of the map that would see the same surfaces. What speaks for and against each
of them gives its confidence: the probability that it is right. The best one is `found` where its
confidence reaches the one that the query asks for, and no other place has more than the rest.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from sceneprint.geometry.registration.icp import error_of, place_covariance, transported
from sceneprint.geometry.registration.overlap import OverlapParameters
from sceneprint.geometry.retrieval.ranking import Ranking
from sceneprint.geometry.rigid import PoseAverage, average_poses, inverse
from sceneprint.geometry.validation.acceptance import Strength
from sceneprint.geometry.validation.confidence import (
    ConfidenceParameters,
    PlaceEvidence,
    confidence_of,
    weakest_evidence,
)
from sceneprint.geometry.validation.map_verification import (
    MapParameters,
    MapViews,
    ScoredPose,
    at_place,
    compare_poses,
    different_views,
    map_frame,
    refined_starts,
    same_place,
    starts_about,
    view_separations,
)
from sceneprint.geometry.validation.validation import preferred
from sceneprint.pipeline import PairMatch, answer_numbers
from sceneprint.types import Floats, Geometry

LocalizationStatus = Literal["found", "ambiguous", "not_found"]
#: What decided: strong matches that vote for the pose; the map's frames, where no match is strong;
#: or what the robot believed before, where the map bears that out as well as any other pose.
Verifier = Literal["matches", "map", "prior"]


@dataclass(frozen=True)
class LocalizationParameters:
    """The numbers of the answer; docs/trust.md says how they were chosen."""

    confidence: float = 0.99  #: least of a pose that is found; other places share the rest
    worth: float = 0.02  #: least confidence of an alternative that is worth a look
    views: int = 5  #: votes that are averaged, and alternatives, at most
    weak: float = 0.4  #: weight of a weak or ambiguous match; a strong one counts 1
    outweigh: float = 2.0  #: times as much weight as any other place, where no map is asked
    voted_only: bool = False  #: whether a pose needs the vote of a match
    prior_share: float = 0.9  #: least score of a pose that a prior decides for, beside the best
    most_noise: float = 0.2  #: violations of the map's own that are believed
    rivals: int = 2  #: frames elsewhere that are compared before a pose is found, at most
    rival_distance: float = 1.2  #: times that of the farthest match for the pose, at most
    map: MapParameters = field(default_factory=MapParameters)
    judgement: ConfidenceParameters = field(default_factory=ConfidenceParameters)


@dataclass(frozen=True, eq=False)
class QueryFrame:
    """A frame of a query, and what came of its candidates.

    Parameters
    ----------
    geometry : artifact of the frame
    matches : of `associate`, accepted or not
    T : (4, 4) T_query_sensor, by odometry; the identity for the frame that is to be placed
    """

    geometry: Geometry
    matches: Sequence[PairMatch]
    T: Floats = field(default_factory=lambda: np.eye(4))


@dataclass(frozen=True, eq=False)
class PosePrior:
    """What a robot believes of its pose before it asks.

    Parameters
    ----------
    parent : frame in which it is given
    T : (4, 4) T_parent_query
    covariance : (6, 6) of errors (x, y, z, rx, ry, rz) in the parent's axes: metres, radians
    """

    parent: str
    T: Floats
    covariance: Floats

    def reaches(self, pose: Floats, p: MapParameters) -> bool:
        """Return whether a frame at T_parent_sensor (4, 4) may see what the robot sees.

        They stand at most `p.same_surfaces` apart, and three deviations of the prior.
        """
        deviation = math.sqrt(float(np.linalg.eigvalsh(self.covariance[:3, :3])[-1]))
        apart = float(np.linalg.norm(pose[:3, 3] - self.T[:3, 3]))
        return apart <= p.same_surfaces + 3 * deviation


@dataclass(frozen=True, eq=False)
class AlternativePose:
    """A pose that the evidence supports.

    Parameters
    ----------
    T : (4, 4) T_parent_query
    support : matches from different viewpoints that vote for it
    weight : of these votes: 1 for a strong match, 0.4 for a weak or an ambiguous one
    confidence : probability that it is right; None where the map was not asked
    evidence : what that was computed from; None where the map was not asked
    """

    T: Floats
    support: int
    weight: float
    confidence: float | None
    evidence: PlaceEvidence | None

    @property
    def score(self) -> float | None:
        """How well the map bears it out; None where it was not asked."""
        return None if self.evidence is None else self.evidence.score


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """Where a query was taken, and how sure that is.

    Parameters
    ----------
    status : found, ambiguous, or not_found
    reason : a short sentence
    parent : frame in which the poses are given
    average : T_parent_query with the spread of the votes and how many agree; None unless found
    covariance : (6, 6) of it, as `place_covariance` orders it; None where a vote has none
    strength : of the matches that vote for it; None unless found
    verified_by : what decided; None unless found
    alternatives : the poses that are worth a look, best first; the answer alone where it is found
    votes : accepted matches that have a pose in the parent frame
    members : rows of the matches that vote for the answer
    guided : how many of these were guided by the others
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

    @property
    def confidence(self) -> float | None:
        """Probability that the best pose is right; None where the map was not asked."""
        return self.alternatives[0].confidence if self.alternatives else None

    @property
    def rival_ratio(self) -> float | None:
        """Score of the best other place, relative to that of the best pose; None likewise."""
        best = self.alternatives[0].evidence if self.alternatives else None
        return None if best is None else best.rival


@dataclass(frozen=True, eq=False)
class _Vote:
    """A pose that a match speaks for, and from where: both (4, 4) in the parent frame."""

    match: PairMatch
    T: Floats
    covariance: Floats | None
    viewpoint: Floats
    weight: float

    @property
    def accepted(self) -> bool:
        return self.match.validation.status == "accepted"


@dataclass(frozen=True, eq=False)
class Place:
    """A place where the query may have been taken.

    Parameters
    ----------
    T : (4, 4) T_parent_query
    votes : of matches, those to believe most first
    support, weight : of the votes from different viewpoints, as in AlternativePose
    evidence : for its pose; None where the map was not asked
    """

    T: Floats
    votes: list[_Vote]
    support: int
    weight: float
    evidence: PlaceEvidence | None

    @property
    def accepted(self) -> list[_Vote]:
        """The votes of accepted matches."""
        return [vote for vote in self.votes if vote.accepted]

    @property
    def strong(self) -> bool:
        """Whether a strong match votes for it."""
        return any(vote.match.validation.strength == "strong" for vote in self.votes)

    @property
    def score(self) -> float:
        """How well the map bears it out."""
        return 0.0 if self.evidence is None else self.evidence.score


#: Gives the frames of a parent frame that may see what a query at poses (n, 4, 4) sees.
ViewsOf = Callable[[str, Floats], MapViews]


def localize(
    frames: Sequence[QueryFrame],
    poses: Sequence[Floats] | Mapping[int, Floats],
    parents: Sequence[str] | Mapping[int, str] | None = None,
    views_of: ViewsOf | None = None,
    prior: PosePrior | None = None,
    p: LocalizationParameters | None = None,
    overlap_p: OverlapParameters | None = None,
) -> PoseEstimate | None:
    """Return where a query was taken, by its matches and the frames of the map.

    Parameters
    ----------
    frames : of the query, one or more
    poses : T_parent_sensor (4, 4) of every row of the database, or by the rows of the matches
    parents : parent frame of every row; default: one for all. Poses are compared within one
        parent frame only: that of the prior, or that of most of the matches
    views_of : see ViewsOf; None: pairs alone decide
    prior : what the robot believed before
    p : default: those of the model that made the artifacts
    overlap_p : see there

    Returns
    -------
    estimate : or None where nothing suggests a pose
    """
    p = p or parameters_of(frames)
    parent, prior, places = judged_places(
        frames, poses, parents, views_of, prior, p, overlap_p or OverlapParameters()
    )
    if not places:
        return None
    blind = all(frame.geometry.surface.camera is None for frame in frames)
    return estimate_of(parent, places, prior, p, blind=blind)


def parameters_of(frames: Sequence[QueryFrame]) -> LocalizationParameters:
    """Return the numbers of the model that made the artifacts of a query; see `answer_numbers`."""
    answer = answer_numbers(frames[0].geometry)
    return LocalizationParameters(map=answer.map, judgement=answer.confidence)


def judged_places(
    frames: Sequence[QueryFrame], poses: Sequence[Floats] | Mapping[int, Floats],
    parents: Sequence[str] | Mapping[int, str] | None, views_of: ViewsOf | None,
    prior: PosePrior | None, p: LocalizationParameters, overlap_p: OverlapParameters,
) -> tuple[str, PosePrior | None, list[Place]]:  # fmt: skip
    """Return every place that a match, the map or the prior suggests, with its evidence.

    Parameters
    ----------
    frames, poses, parents, views_of, prior, p, overlap_p : see `localize`

    Returns
    -------
    parent : frame in which poses are compared
    prior : the one given; None where it is of another parent frame
    places : those with votes first, then by score
    """
    parent = _parent(frames, parents)
    if prior is not None and prior.parent != parent:
        if _accepts(frames, parents, parent) and not _accepts(frames, parents, prior.parent):
            prior = None  # what it says of one parent frame tells nothing of another
        else:
            parent = prior.parent
    own = [
        replace(frame, matches=[
            m for m in frame.matches if parents is None or parents[m.index] == parent
        ])
        for frame in frames
    ]  # fmt: skip
    suggested, viewpoints = _suggested(own, poses)
    votes = _votes(own, poses, p)
    if views_of is None or (not len(suggested) and prior is None):
        return parent, prior, [_place(group, None, p) for group in _grouped(votes, [], p)]
    ready = [map_frame(one.geometry, one.T, p.map, overlap_p) for one in frames]
    starts = _NONE if prior is None else starts_about(prior.T, prior.covariance, p.map)
    views = views_of(parent, np.concatenate([starts[:1], suggested]))
    near = refined_starts(ready, starts, views, p.map, overlap_p)
    scored = compare_poses(ready, np.concatenate([near, suggested]), views, p.map, overlap_p)
    return parent, prior, _places(votes, scored, suggested, viewpoints, views, p)


def views_of_rows(
    matches: Sequence[PairMatch],
    poses: Sequence[Floats],
    open_geometry: Callable[[int], Geometry | None],
    parents: Sequence[str] | None = None,
    p: MapParameters | None = None,
    overlap_p: OverlapParameters | None = None,
    ahead: Sequence[bool] | None = None,
) -> ViewsOf:
    """Return what `localize` asks the map with, where all poses of a database are at hand.

    Parameters
    ----------
    matches : of the query: poses are first compared on their rows
    poses : T_parent_sensor (4, 4) of every row
    open_geometry : artifact of a row, or None
    parents : parent frame of every row; default: one for all
    p, overlap_p : see there
    ahead : of every row, whether its sensor looks along z; default: all do
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
        )

    return views_of


@dataclass(frozen=True, eq=False)
class PosedFrame:
    """A frame of the map: its parent frame, T_parent_sensor (4, 4), whether it looks along z."""

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
    """Frames that look like the query, but show another place than the one that is found.

    Where two rooms are equal and were mapped from the same viewpoints, each signature is there
    twice, and C keeps one of the two: all of C may be of the wrong room. So no pose is found
    before frames elsewhere whose signatures are as near as those that vote were validated too.

    Parameters
    ----------
    estimate : of `localize`
    ranking : R
    tried : rows that were validated
    posed : describes those of some rows that have a pose
    query_ahead : whether the query's sensor looks along z
    p : see there

    Returns
    -------
    rows : the first of R, `p.rivals` at most; none where nothing is found, or the prior decided
    """
    p = p or LocalizationParameters()
    if estimate is None or estimate.average is None or estimate.verified_by == "prior":
        return []
    order = ranking.indices.tolist()
    voting = [i for i, row in enumerate(order) if row in (estimate.members or tried)]
    if not voting:
        return []
    near = ranking.distances <= p.rival_distance * ranking.distances[voting[-1]]
    untried = [order[i] for i in np.flatnonzero(near) if order[i] not in tried]
    known = {n: one for n, one in posed(untried).items() if one.parent == estimate.parent}
    rows = [row for row in untried if row in known]
    if not rows:
        return []
    poses = np.stack([known[row].T for row in rows])
    ahead = np.array([known[row].ahead for row in rows])
    apart = view_separations(poses, ahead, estimate.average.T, query_ahead, p.map)
    return [row for row, far in zip(rows, apart >= 1.0, strict=True) if far][: p.rivals]


def unconfirmed(estimate: PoseEstimate) -> PoseEstimate:
    """A pose that was found, as ambiguous: frames that look alike elsewhere were not compared."""
    if estimate.average is None:
        return estimate
    return replace(
        estimate, status="ambiguous", average=None, covariance=None, strength=None,
        verified_by=None, members=(), guided=0,
        reason="the deadline passed before frames of another place that look alike were compared; "
        "allow more time",
    )  # fmt: skip


_NONE = np.empty((0, 4, 4))


def _parent(frames: Sequence[QueryFrame], parents: Sequence[str] | Mapping[int, str] | None) -> str:
    """The parent frame with most strong matches, of equals with most accepted, with most at all."""
    counts: dict[str, tuple[int, int, int]] = {}
    for frame in frames:
        for match in frame.matches:
            name = "" if parents is None else parents[match.index]
            strong, accepted, tried = counts.get(name, (0, 0, 0))
            v = match.validation
            counts[name] = (
                strong + (v.strength == "strong"), accepted + (v.status == "accepted"), tried + 1
            )  # fmt: skip
    # the first of equals: dicts keep the order in which parents came
    return max(counts, key=counts.__getitem__, default="")


def _accepts(
    frames: Sequence[QueryFrame], parents: Sequence[str] | Mapping[int, str] | None, parent: str
) -> bool:
    """Whether a match of a parent frame is accepted."""
    return any(
        match.validation.status == "accepted"
        and ("" if parents is None else parents[match.index]) == parent
        for frame in frames
        for match in frame.matches
    )


def _suggested(
    frames: Sequence[QueryFrame], poses: Sequence[Floats] | Mapping[int, Floats]
) -> tuple[Floats, Floats]:
    """Every pose (n, 4, 4) that a candidate suggests, and the pose of each one's candidate.

    The best of each candidate come first, then the next best.
    """
    of_each = [
        (poses[match.index], poses[match.index] @ match.validation.hypotheses @ inverse(frame.T))
        for frame in frames
        for match in frame.matches
        # of a sensor that cannot have stood so
        if len(match.validation.hypotheses) and not match.validation.contradicts_up
    ]
    most = max((len(told) for _, told in of_each), default=0)
    pairs = [
        (told[rank], viewpoint)
        for rank in range(most)
        for viewpoint, told in of_each
        if rank < len(told)
    ]
    both = np.array(pairs).reshape(-1, 2, 4, 4)
    return both[:, 0], both[:, 1]


def _votes(
    frames: Sequence[QueryFrame], poses: Sequence[Floats] | Mapping[int, Floats],
    p: LocalizationParameters,
) -> list[_Vote]:  # fmt: skip
    """Votes of accepted matches in the order of belief, then those of ambiguous ones."""
    votes: list[_Vote] = []
    for frame in frames:
        first = preferred([match.validation for match in frame.matches])
        unsure = [i for i, m in enumerate(frame.matches) if m.validation.status == "ambiguous"]
        for match in [frame.matches[i] for i in [*first, *unsure]]:
            v, viewpoint = match.validation, poses[match.index]
            if v.T_match_query is None:
                continue
            covariance = v.covariance
            if covariance is not None:
                covariance = transported(covariance, viewpoint[:3, :3], np.zeros(3))
            weight = 1.0 if v.strength == "strong" else p.weak
            T = viewpoint @ v.T_match_query @ inverse(frame.T)
            votes.append(_Vote(match, T, covariance, viewpoint, weight))
    if len(frames) > 1:
        order = preferred([vote.match.validation for vote in votes])
        votes = [votes[i] for i in order] + [vote for vote in votes if not vote.accepted]
    return votes


def _grouped(
    votes: Sequence[_Vote], scored: Sequence[ScoredPose], p: LocalizationParameters
) -> list[list[_Vote]]:
    """Group votes by place: of the scored poses, in their order, then by themselves."""
    groups: list[list[_Vote]] = [[] for _ in scored]
    others: list[list[_Vote]] = []
    for vote in votes:
        at = next((k for k, one in enumerate(scored) if one.is_of(vote.T, p.map)), None)
        if at is not None:
            groups[at].append(vote)
            continue
        for group in others:
            if same_place(group[0].T, vote.T, p.map):
                group.append(vote)
                break
        else:
            others.append([vote])
    return groups + others


def _places(
    votes: Sequence[_Vote], scored: Sequence[ScoredPose], suggested: Floats, viewpoints: Floats,
    views: MapViews, p: LocalizationParameters,
) -> list[Place]:  # fmt: skip
    """Return the places of votes and scored poses, with the evidence for each."""
    groups = _grouped(votes, scored, p)
    weights = [_weight(group, p)[1] for group in groups]
    scores = [one.score for one in scored]
    places = []
    for k, group in enumerate(groups):
        pose = scored[k] if k < len(scored) else None
        others = scores[:k] + scores[k + 1 :]
        evidence = _evidence(
            group, pose, suggested, viewpoints, views,
            max(others, default=0.0), max(weights[:k] + weights[k + 1 :], default=0.0), p,
        )  # fmt: skip
        places.append(_place(group, pose, p, evidence))
    return sorted(places, key=lambda place: not place.votes)


def _place(
    group: list[_Vote], pose: ScoredPose | None, p: LocalizationParameters,
    evidence: PlaceEvidence | None = None,
) -> Place:  # fmt: skip
    """Return the place of some votes, or of a scored pose, or of both."""
    accepted = any(vote.accepted for vote in group)
    T = group[0].T if pose is None or accepted else pose.T
    support, weight = _weight(group, p)
    return Place(T, group, support, weight, evidence)


def _weight(group: Sequence[_Vote], p: LocalizationParameters) -> tuple[int, float]:
    """Return how many viewpoints vote, and the weight of their first votes.

    Neither a copy of a view nor what other matches gave is a vote of its own.
    """
    voting = [vote for vote in group if not vote.match.validation.guided]
    viewpoints = np.array([vote.viewpoint for vote in voting]).reshape(-1, 4, 4)
    different = different_views(viewpoints, p.map)
    return len(different), sum(voting[i].weight for i in different)


def _evidence(
    group: Sequence[_Vote], pose: ScoredPose | None, suggested: Floats, viewpoints: Floats,
    views: MapViews, rival: float, rival_weight: float, p: LocalizationParameters,
) -> PlaceEvidence:  # fmt: skip
    """Return the evidence for a place: of its votes and of its pose on the map.

    Parameters
    ----------
    group : votes
    pose : None where none at the place was scored
    suggested, viewpoints : see `_suggested`
    views : the map's frames
    rival, rival_weight : best score, and largest weight, of another place
    p : see LocalizationParameters
    """
    weight = _weight(group, p)[1]
    strong = _weight([v for v in group if v.match.validation.strength == "strong"], p)[0]
    T = group[0].T if pose is None else pose.T
    suggesting = len(different_views(viewpoints[at_place(suggested, T, p.map)], p.map))
    if pose is None:
        return PlaceEvidence(
            0.0, 0.0, 0.0, 0, 0, 1.0, weight, strong, suggesting, 1.0, rival_weight
        )
    agreeing = np.unique([i for _, i in pose.views]).astype(np.intp)
    seen_from = len(different_views(views.poses[agreeing], p.map))
    excess = pose.violations + pose.hidden - min(pose.noise, p.most_noise)
    ratio = max(rival, 0.0) / pose.score if pose.score > 0 else 1.0
    return PlaceEvidence(
        pose.score, pose.share, pose.planes, len(agreeing), seen_from, excess, weight, strong,
        suggesting, ratio, rival_weight,
    )  # fmt: skip


def estimate_of(
    parent: str, places: Sequence[Place], prior: PosePrior | None, p: LocalizationParameters, *,
    blind: bool = False,
) -> PoseEstimate:  # fmt: skip
    """Return the verdict on places.

    Parameters
    ----------
    parent, prior, places : of `judged_places`; one place or more
    p : see LocalizationParameters
    blind : whether nothing is known of free space
    """
    if all(place.evidence is None for place in places):
        return _estimate_by_votes(parent, places, blind, p)
    judged = _confidences(places, p)
    order = sorted(range(len(places)), key=lambda i: (-judged[i], -places[i].score))
    others = max((judged[i] for i in order[1:]), default=0.0)
    best = places[order[0]]
    if judged[order[0]] >= p.confidence and others <= 1.0 - p.confidence:
        verified_by: Verifier = "matches" if best.strong else "map"
        return _found(parent, best, places, verified_by, judged[order[0]], p)
    if prior is not None:
        inside = _confirmed_by_prior(places, prior, p)
        if inside is not None:
            place, confidence = inside
            return _found(parent, place, places, "prior", confidence, p)
    worth = [i for i in order if judged[i] >= p.worth][: p.views]
    alternatives = tuple(
        AlternativePose(one.T, one.support, one.weight, judged[i], one.evidence)
        for i in worth
        for one in (places[i],)
    )
    reason = weakest_evidence(_known(best.evidence), p.judgement)
    votes = sum(len(place.accepted) for place in places)
    status: LocalizationStatus = "ambiguous" if alternatives else "not_found"
    return PoseEstimate(status, reason, parent, None, None, None, None, alternatives, votes)


def _known(evidence: PlaceEvidence | None) -> PlaceEvidence:
    assert evidence is not None
    return evidence


def _confidences(places: Sequence[Place], p: LocalizationParameters) -> list[float]:
    """Return the confidence of each place; together they are at most 1, as one at most is right."""
    judged = [
        0.0
        if p.voted_only and not place.votes
        else confidence_of(_known(place.evidence), p.judgement)
        for place in places
    ]
    whole = max(sum(judged), 1.0)
    return [one / whole for one in judged]


def _confirmed_by_prior(
    places: Sequence[Place], prior: PosePrior, p: LocalizationParameters
) -> tuple[Place, float] | None:
    """Return the place that the prior decides for, and its confidence; None where it does not.

    Places that the prior does not expect are no rivals of those that it does, provided that they
    fit the map no better.
    """
    inside = [place for place in places if is_expected(place.T, prior)]
    most = max(place.score for place in places)
    within = []
    for place in inside:
        others = [one for one in inside if one is not place]
        rival = max((one.score for one in others), default=0.0)
        evidence = replace(
            _known(place.evidence), rival=rival / place.score if place.score > 0 else 1.0,
            rival_weight=max((one.weight for one in others), default=0.0),
        )  # fmt: skip
        within.append(replace(place, evidence=evidence))
    judged = _confidences(within, p)
    best = max(range(len(within)), key=judged.__getitem__, default=None)
    if best is None or judged[best] < p.confidence or within[best].score < p.prior_share * most:
        return None
    return within[best], judged[best]


def _estimate_by_votes(
    parent: str, places: Sequence[Place], blind: bool, p: LocalizationParameters
) -> PoseEstimate:
    """Return the verdict on places by their votes alone, where the map is not asked."""
    order = sorted(places, key=lambda place: (not place.accepted, -place.weight))
    best, heaviest = order[0], max((place.weight for place in order[1:]), default=0.0)
    against = None
    if not best.accepted:
        against = "no match is accepted"
    elif heaviest * p.outweigh > best.weight:
        against = "the matches disagree: none of their poses has twice the weight of the next"
    elif not best.strong and not blind:
        against = "the accepted matches are weak"
    if against is None:
        return _found(parent, best, places, "matches", None, p)
    alternatives = tuple(
        AlternativePose(one.T, one.support, one.weight, None, None) for one in order[: p.views]
    )
    votes = sum(len(place.accepted) for place in places)
    return PoseEstimate("ambiguous", against, parent, None, None, None, None, alternatives, votes)


def is_expected(T: Floats, prior: PosePrior) -> bool:
    """Whether a pose lies where the prior has 99.9 % of its mass."""
    off = error_of(prior.T, T)
    return float(off @ np.linalg.solve(prior.covariance, off)) <= _CHI_SQUARE_6


#: 99.9 % of a chi-square of six degrees of freedom.
_CHI_SQUARE_6 = 22.458


def _found(
    parent: str, place: Place, places: Sequence[Place], verified_by: Verifier,
    confidence: float | None, p: LocalizationParameters,
) -> PoseEstimate:  # fmt: skip
    """Return the answer that a query was taken at a place."""
    accepted = place.accepted
    votes = accepted[: p.views]
    covariances = [vote.covariance for vote in votes if vote.covariance is not None]
    average = average_poses(np.stack([vote.T for vote in votes] or [place.T]))
    covariance = None
    if votes and len(covariances) == len(votes):
        poses = np.stack([vote.T for vote in votes])
        covariance = place_covariance(average, poses, np.stack(covariances))
    total = sum(len(one.accepted) for one in places)
    guided = sum(vote.match.validation.guided for vote in accepted)
    reason = _found_reason(average, len(accepted), guided, total, place.support, verified_by)
    strength: Strength = "strong" if place.strong else "weak"
    itself = AlternativePose(average.T, place.support, place.weight, confidence, place.evidence)
    return PoseEstimate(
        "found", reason, parent, average, covariance, strength, verified_by, (itself,), total,
        tuple(vote.match.index for vote in accepted), guided,
    )  # fmt: skip


def _found_reason(
    average: PoseAverage, agreeing: int, guided: int, accepted: int, support: int,
    verified_by: Verifier,
) -> str:  # fmt: skip
    """Return a sentence on what the answer rests on."""
    if verified_by == "map":
        return "the map's frames confirm this pose, and no other comes near"
    if verified_by == "prior":
        return "several poses fit, and only this one lies where the prior expects the robot"
    if agreeing == 1:
        reason = "one match gives the pose"
        return reason if accepted == 1 else f"{reason}, and {accepted - 1} weaker ones disagree"
    spread = (
        f", within {average.spread_m:.2g} m and {math.degrees(average.spread_rad):.2g} deg"
        if average.support > 1
        else ""
    )
    reason = f"{agreeing} of {accepted} matches agree on the pose{spread}"
    if guided:
        reason += f"; {guided} of them followed from the others"
    return f"{reason}, all from one viewpoint" if support == 1 else reason
