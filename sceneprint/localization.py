"""Validated matches to where the query was taken: found, ambiguous, or not found.

matches, poses, MapViews  --localize-->  PoseEstimate

Accepted matches vote with their poses. Their votes are clustered, and the best cluster is the
answer only where nothing comes near it: neither another cluster, nor any other pose that the
candidates suggest, judged on all frames of the map that would see it. Where the matches decide
nothing, the map alone may, if one pose explains the query far better than every other.
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
from sceneprint.pipeline import PairMatch
from sceneprint.types import Floats, Geometry

LocalizationStatus = Literal["found", "ambiguous", "not_found"]
#: What decided: the votes of accepted matches; the map's frames, where these did not suffice; or
#: what the robot believed before, where the map bears it out as well as any other pose.
Verifier = Literal["matches", "map", "prior"]


@dataclass(frozen=True)
class LocalizationParameters:
    """The numbers of the answer; how they were chosen: docs/trust.md."""

    views: int = 5  #: votes that are averaged, at most
    weak: float = 0.4  #: weight of a weak or ambiguous match; a strong one counts 1
    outweigh: float = 2.0  #: times as much weight as any other place
    sure_weight: float = 2.0  #: of a place, that two strong matches give it
    planes: float = 6.0  #: distinct ones that must agree at any pose, where the map is asked
    rival: float = 0.6  #: of its score, above which another pose makes it ambiguous
    rival_unsure: float = 0.3  #: the same of a place with less weight, and without any
    violations: float = 0.05  #: most, beyond the map's own, for each unit of weight, two at most
    lone_views: int = 3  #: viewpoints of frames that agree with a pose that only one suggests
    map_confirms: bool = True  #: whether the map's frames may decide without a strong match
    map_score: float = 0.3  #: least score of a pose that the map confirms without a strong match
    map_planes: float = 12.0  #: and least number of distinct planes that agree
    map_violations: float = 0.03  #: and most violations, beyond the map's own
    map_views: int = 8  #: and least number of frames of the map that agree
    map_viewpoints: int = 2  #: from which candidates suggest it, where no match votes for it
    prior_rival: float = 0.65  #: of its score that another pose near the prior may reach
    prior_share: float = 0.9  #: least score of that pose, beside the best anywhere
    most_noise: float = 0.2  #: violations of the map's own that are believed
    rivals: int = 2  #: frames elsewhere that are compared before a pose is found, at most
    rival_distance: float = 1.2  #: times that of the farthest match for the pose, at most
    map: MapParameters = field(default_factory=MapParameters)


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


#: Metres between two cameras that still see the same surfaces.
SAME_SURFACES_M = 8.0


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

    def reaches(self, pose: Floats) -> bool:
        """Whether a frame at T_parent_sensor (4, 4) may see what the robot sees.

        They stand at most `SAME_SURFACES_M` apart, and three deviations of the prior.
        """
        deviation = math.sqrt(float(np.linalg.eigvalsh(self.covariance[:3, :3])[-1]))
        apart = float(np.linalg.norm(pose[:3, 3] - self.T[:3, 3]))
        return apart <= SAME_SURFACES_M + 3 * deviation


@dataclass(frozen=True, eq=False)
class AlternativePose:
    """A pose that the evidence supports.

    Parameters
    ----------
    T : (4, 4) T_parent_query
    weight : of its votes: 1 for a strong match, 0.4 for a weak or an ambiguous one
    support : matches from different viewpoints that vote for it
    score : how far the map bears it out, 1 at most; None where it was not asked
    """

    T: Floats
    weight: float
    support: int
    score: float | None


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
    alternatives : the poses that the evidence supports, the answer among them, best first; more
        than one only where the answer is ambiguous
    rival_ratio : the next best place's score by that of the best; None where no map was asked
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
    rival_ratio: float | None
    votes: int = 0
    members: tuple[int, ...] = ()
    guided: int = 0


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
class _Place:
    """The votes for one place, those to believe most first, and how the map bears it out.

    Parameters
    ----------
    weight, support : of the votes from different viewpoints
    viewpoints : from which a candidate suggests it, voting or not
    seen_from : viewpoints of the map's frames that agree with it
    """

    votes: list[_Vote]
    weight: float
    support: int
    viewpoints: int
    seen_from: int = 0
    scored: ScoredPose | None = None

    @property
    def accepted(self) -> bool:
        return any(vote.accepted for vote in self.votes)

    @property
    def strong(self) -> bool:
        return any(vote.match.validation.strength == "strong" for vote in self.votes)

    @property
    def pose(self) -> Floats:
        if self.scored is not None and not self.accepted:
            return self.scored.T
        return self.votes[0].T

    @property
    def score(self) -> float:
        return 0.0 if self.scored is None else self.scored.score


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
    """Where a query was taken: the poses that its matches and the map support, compared.

    Parameters
    ----------
    frames : of the query, one or more
    poses : T_parent_sensor (4, 4) of every row of the database, or by the rows of the matches
    parents : parent frame of every row; default: one for all. Poses are compared within one
        parent frame only: that of the prior, or that of most of the matches
    views_of : see ViewsOf; None: pairs alone decide
    prior : what the robot believed before
    p, overlap_p : see there

    Returns
    -------
    estimate : or None where nothing suggests a pose
    """
    p, overlap_p = p or LocalizationParameters(), overlap_p or OverlapParameters()
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
    scored: list[ScoredPose] = []
    views: MapViews | None = None
    if views_of is not None and (len(suggested) or prior is not None):
        ready = [map_frame(one.geometry, one.T, p.map, overlap_p) for one in frames]
        starts = _NONE if prior is None else starts_about(prior.T, prior.covariance)
        views = views_of(parent, np.concatenate([starts[:1], suggested]))
        near = refined_starts(ready, starts, views, p.map, overlap_p)
        scored = compare_poses(ready, np.concatenate([near, suggested]), views, p.map, overlap_p)
    places = _places(_votes(own, poses, p), scored, suggested, viewpoints, views, p)
    if not places:
        return None
    blind = all(frame.geometry.surface.camera is None for frame in frames)
    return _estimate(parent, places, prior, bool(scored), blind, p)


def views_of_rows(
    matches: Sequence[PairMatch],
    poses: Sequence[Floats],
    open_geometry: Callable[[int], Geometry | None],
    parents: Sequence[str] | None = None,
    p: MapParameters | None = None,
    overlap_p: OverlapParameters | None = None,
) -> ViewsOf:
    """What `localize` asks the map with, where all poses of a database are at hand.

    Parameters
    ----------
    matches : of the query: poses are first compared on their rows
    poses : T_parent_sensor (4, 4) of every row
    open_geometry : artifact of a row, or None
    parents : parent frame of every row; default: one for all
    p, overlap_p : see there
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


def _places(
    votes: Sequence[_Vote], scored: Sequence[ScoredPose], suggested: Floats, viewpoints: Floats,
    views: MapViews | None, p: LocalizationParameters,
) -> list[_Place]:  # fmt: skip
    """Votes and scored poses by place: those with votes first, then by score."""
    groups: list[list[_Vote]] = []
    for vote in votes:
        for group in groups:
            if same_place(group[0].T, vote.T, p.map):
                group.append(vote)
                break
        else:
            groups.append([vote])

    def suggesting(T: Floats) -> int:
        return len(different_views(viewpoints[at_place(suggested, T, p.map)], p.map))

    def seen_from(pose: ScoredPose | None) -> int:
        if pose is None or views is None:
            return 0
        agreeing = np.unique([i for _, i in pose.views]).astype(np.intp)
        return len(different_views(views.poses[agreeing], p.map))

    left = list(scored)
    places = []
    for group in groups:
        own = next((one for one in left if same_place(group[0].T, one.T, p.map)), None)
        left = [one for one in left if one is not own]
        # neither a copy of a view nor what other matches gave is a vote of its own
        voting = [vote for vote in group if not vote.match.validation.guided]
        from_where = np.array([vote.viewpoint for vote in voting]).reshape(-1, 4, 4)
        different = different_views(from_where, p.map)
        weight = sum(voting[i].weight for i in different)
        suggested_by = suggesting(group[0].T)
        places.append(_Place(group, weight, len(different), suggested_by, seen_from(own), own))
    return places + [_Place([], 0.0, 0, suggesting(one.T), seen_from(one), one) for one in left]


def _estimate(
    parent: str, places: Sequence[_Place], prior: PosePrior | None, mapped: bool, blind: bool,
    p: LocalizationParameters,
) -> PoseEstimate:  # fmt: skip
    """The verdict on places, one or more."""
    by_score = sorted(places, key=lambda place: -place.score)
    best, ratio = by_score[0], None
    if mapped:
        next_best = by_score[1].score if len(by_score) > 1 else 0.0
        ratio = min(max(next_best / best.score, 0.0), 1.0) if best.score > 0 else 1.0
    voted = max(places, key=lambda place: (place.accepted, place.weight, place.score))
    against = _against_votes(voted, places, mapped, blind, p)
    if against is None:
        return _found(parent, voted, places, "matches", ratio, p)
    if mapped and _map_confirms(best, places, p):
        return _found(parent, best, places, "map", ratio, p)
    if prior is not None and mapped:
        inside = _confirmed_by_prior(by_score, prior, p)
        if inside is not None:
            return _found(parent, inside, places, "prior", ratio, p)
    least = max(p.map_score, 0.5 * best.score)
    told = [
        place for place in sorted(places, key=lambda one: (-one.weight, -one.score))
        # what a caller asks of a match, a pose that no match votes for does not meet
        if place.votes or (p.map_confirms and place.score >= least)
    ]  # fmt: skip
    if not any(one.votes or _planes(one) >= p.map_planes for one in told):
        told = []  # a few planes fit in many places
    alternatives = tuple(
        AlternativePose(one.pose, one.weight, one.support, one.score if mapped else None)
        for one in told[: p.views]
    )
    status: LocalizationStatus = "ambiguous" if told else "not_found"
    votes = sum(vote.accepted for place in places for vote in place.votes)
    return PoseEstimate(status, against, parent, None, None, None, None, alternatives, ratio, votes)


def _against_votes(
    voted: _Place, places: Sequence[_Place], mapped: bool, blind: bool,
    p: LocalizationParameters,
) -> str | None:  # fmt: skip
    """Why the place with most votes is not the answer; None where it is."""
    others = [place for place in places if place is not voted]
    if not voted.accepted:
        return "no match is accepted, and the map's frames confirm none of the poses that fit"
    heaviest = max((place.weight for place in others), default=0.0)
    if heaviest * p.outweigh > voted.weight:
        return "the matches disagree: none of their poses has twice the weight of the next"
    if mapped:
        score = max((place.score for place in others), default=0.0)
        sure = voted.weight >= p.sure_weight
        if score > (p.rival if sure else p.rival_unsure) * voted.score:
            return (
                "another pose explains the frame as well: the place repeats, or has a symmetry"
                if score > p.rival * voted.score
                else "too little speaks for the pose while another explains much of the frame"
            )
        if _planes(voted) < p.planes:
            return (
                f"only {_planes(voted):.0f} distinct planes agree, and a few planes fit in many "
                "places"
            )
        excess = _excess(voted, p)
        # more votes are no more evidence: in a room of two like ends all are for the wrong one
        if excess > p.violations * min(max(voted.weight, 1.0), p.sure_weight):
            return (
                f"a pose fits, but {excess:.0%} of what should be in sight there is missing: "
                "another place may look like this one, or this one has changed"
            )
        if voted.viewpoints == 1 and voted.seen_from >= p.lone_views:
            return f"one view alone suggests this pose, of {voted.seen_from} that see the place"
    if not voted.strong and not blind:
        return "the accepted matches are weak, and the map's other frames do not confirm them"
    return None


def _map_confirms(best: _Place, places: Sequence[_Place], p: LocalizationParameters) -> bool:
    """Whether the map alone decides for the place with the best score."""
    if best.scored is None or not p.map_confirms:
        return False
    others = [place for place in places if place is not best]
    frames = {i for _, i in best.scored.views}
    return (
        (bool(best.votes) or best.viewpoints >= p.map_viewpoints)
        and best.score >= p.map_score
        and max((place.score for place in others), default=0.0) <= p.rival_unsure * best.score
        and best.scored.planes >= p.map_planes
        and len(frames) >= p.map_views
        and max((place.weight for place in others), default=0.0) < 1.0
        and _excess(best, p) <= p.map_violations
    )


def _confirmed_by_prior(
    by_score: Sequence[_Place], prior: PosePrior, p: LocalizationParameters
) -> _Place | None:
    """The one place near the prior that the map bears out as well as any other."""
    inside = [place for place in by_score if is_expected(place.pose, prior)]
    if not inside or inside[0].scored is None:
        return None
    best = inside[0]
    next_best = inside[1].score if len(inside) > 1 else 0.0
    sure = (
        best.score >= p.map_score
        and _planes(best) >= p.planes
        and next_best <= p.prior_rival * best.score
        and best.score >= p.prior_share * by_score[0].score
        and _excess(best, p) <= p.violations
    )
    return best if sure else None


def is_expected(T: Floats, prior: PosePrior) -> bool:
    """Whether a pose lies where the prior has 99.9 % of its mass."""
    off = error_of(prior.T, T)
    return float(off @ np.linalg.solve(prior.covariance, off)) <= _CHI_SQUARE_6


#: 99.9 % of a chi-square of six degrees of freedom.
_CHI_SQUARE_6 = 22.458


def _planes(place: _Place) -> float:
    return 0.0 if place.scored is None else place.scored.planes


def _excess(place: _Place, p: LocalizationParameters) -> float:
    """Violations of both sides, less those that the map's own frames show."""
    if place.scored is None:
        return 1.0
    one = place.scored
    return one.violations + one.hidden - min(one.noise, p.most_noise)


def _found(
    parent: str, place: _Place, places: Sequence[_Place], verified_by: Verifier,
    ratio: float | None, p: LocalizationParameters,
) -> PoseEstimate:  # fmt: skip
    accepted = [vote for vote in place.votes if vote.accepted]
    votes = accepted[: p.views]
    told = [vote.covariance for vote in votes if vote.covariance is not None]
    average = average_poses(np.stack([vote.T for vote in votes] or [place.pose]))
    covariance = None
    if votes and len(told) == len(votes):
        poses = np.stack([vote.T for vote in votes])
        covariance = place_covariance(average, poses, np.stack(told))
    total = sum(vote.accepted for one in places for vote in one.votes)
    guided = sum(vote.match.validation.guided for vote in accepted)
    reason = _found_reason(average, len(accepted), guided, total, place.support, verified_by)
    strength: Strength = "strong" if place.strong else "weak"
    score = None if place.scored is None else place.score
    itself = AlternativePose(average.T, place.weight, place.support, score)
    return PoseEstimate(
        "found", reason, parent, average, covariance, strength, verified_by, (itself,), ratio,
        total, tuple(vote.match.index for vote in accepted), guided,
    )  # fmt: skip


def _found_reason(
    average: PoseAverage, agreeing: int, guided: int, accepted: int, support: int,
    verified_by: Verifier,
) -> str:  # fmt: skip
    if verified_by == "map":
        return "the map's frames confirm this pose, and no other comes near"
    if verified_by == "prior":
        return "several poses fit, and only this one lies where the prior expects the robot"
    if agreeing == 1:
        told = "one match gives the pose; one view, unconfirmed"
        return told if accepted == 1 else f"{told}, and {accepted - 1} weaker ones disagree"
    spread = (
        f", within {average.spread_m:.2g} m and {math.degrees(average.spread_rad):.2g} deg"
        if average.support > 1
        else ""
    )
    told = f"{agreeing} of {accepted} matches agree on the pose{spread}"
    if guided:
        told += f"; {guided} of them followed from the others"
    return f"{told}, all from one viewpoint" if support == 1 else told
