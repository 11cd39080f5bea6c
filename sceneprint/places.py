"""Evidence for the possible places of a query, from its matches, the map and a prior.

matches, poses, MapViews  --judge_places-->  Place, ...

Accepted matches vote with their poses. These poses, and further poses that candidates suggest, are
compared with the frames of the map that would see the same surfaces.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sceneprint.geometry.registration.icp import pose_error, transform_covariance
from sceneprint.geometry.registration.overlap import OverlapParameters
from sceneprint.geometry.rigid import inverse
from sceneprint.geometry.validation.confidence import ConfidenceModel, PlaceEvidence
from sceneprint.geometry.validation.map_verification import (
    MapParameters,
    MapViews,
    ScoredPose,
    at_place,
    compare_poses,
    distinct_viewpoints,
    looks_ahead,
    map_frame,
    prior_starts,
    refine_starts,
    same_place,
    view_separations,
)
from sceneprint.geometry.validation.validation import rank_accepted
from sceneprint.models.model import AnswerParameters
from sceneprint.pipeline import PairMatch, answer_parameters
from sceneprint.types import Floats, Geometry


@dataclass(frozen=True)
class LocalizationParameters:
    """Parameters of localization; docs/trust.md describes how they were tuned."""

    confidence: float = 0.99  #: minimum confidence of a pose that is found
    worth: float = 0.05  #: minimum confidence of an alternative
    views: int = 5  #: maximum number of averaged votes, and of alternatives
    half_weight: float = 1 / 30  #: separation of two views that halves the weight of a vote
    weak: float = 0.4  #: weight of a weak or ambiguous match; a strong match has weight 1
    outweigh: float = 2.0  #: minimum ratio of the weights of the best two places if there is no map
    voted_only: bool = False  #: whether a pose requires a vote from a match
    prior_odds: float = 20.0  #: factor by which a prior raises the odds of an expected pose
    prior_share: float = 0.9  #: minimum score of a pose that a prior confirms, share of best score
    most_noise: float = 0.2  #: maximum share of violations that is attributed to the map's noise
    rivals: int = 2  #: maximum number of frames of other places that are compared
    rival_distance: float = 1.2  #: their maximum distance, relative to the farthest voting match
    map: MapParameters = field(default_factory=MapParameters)
    judgement: ConfidenceModel = field(default_factory=ConfidenceModel)

    @classmethod
    def of(cls, answer: AnswerParameters) -> LocalizationParameters:
        """Return the defaults, with the answer parameters of a model."""
        return cls(map=answer.map, judgement=answer.confidence)


@dataclass(frozen=True, eq=False)
class QueryFrame:
    """A frame of a query, with the matches of its candidates.

    Parameters
    ----------
    geometry : artifact of the frame
    matches : results of `associate`, accepted or not
    T : (4, 4) T_query_sensor from odometry; the identity for the frame that is localized
    """

    geometry: Geometry
    matches: Sequence[PairMatch]
    T: Floats = field(default_factory=lambda: np.eye(4))


@dataclass(frozen=True, eq=False)
class PosePrior:
    """The pose that a robot expects, and its uncertainty.

    Parameters
    ----------
    parent : parent frame of the pose
    T : (4, 4) T_parent_query
    covariance : (6, 6) covariance of the error (x, y, z, rx, ry, rz) along the parent's axes,
        metres and radians
    """

    parent: str
    T: Floats
    covariance: Floats

    def reaches(self, pose: Floats, p: MapParameters) -> bool:
        """Return whether a frame at T_parent_sensor (4, 4) may see the same surfaces as the robot.

        The maximum distance is `p.same_surfaces` plus three standard deviations of the prior.
        """
        deviation = math.sqrt(float(np.linalg.eigvalsh(self.covariance[:3, :3])[-1]))
        apart = float(np.linalg.norm(pose[:3, 3] - self.T[:3, 3]))
        return apart <= p.same_surfaces + 3 * deviation

    def expects(self, T: Floats) -> bool:
        """Return whether T_parent_query (4, 4) lies within the prior's 99.9 % confidence region."""
        error = pose_error(self.T, T)
        return float(error @ np.linalg.solve(self.covariance, error)) <= _CHI_SQUARE_6


#: 99.9 % quantile of the chi-square distribution with six degrees of freedom.
_CHI_SQUARE_6 = 22.458


@dataclass(frozen=True, eq=False)
class _Vote:
    """A match's vote for a pose T of the query; T and `viewpoint` are (4, 4), in the parent frame.

    `separation` is that between the views of the query and of the match; see `view_separations`.
    """

    match: PairMatch
    T: Floats
    covariance: Floats | None
    viewpoint: Floats
    separation: float
    weight: float

    @property
    def accepted(self) -> bool:
        return self.match.validation.status == "accepted"


@dataclass(frozen=True, eq=False)
class Place:
    """A place at which the query may have been taken.

    Parameters
    ----------
    T : (4, 4) T_parent_query
    votes : votes for the place, most reliable first
    support : number of different viewpoints of the voting matches
    weight : total weight of the votes: 1 for a strong match, less for a weak or ambiguous match
    evidence : evidence for the pose; None without a map
    """

    T: Floats
    votes: list[_Vote]
    support: int
    weight: float
    evidence: PlaceEvidence | None

    @property
    def accepted(self) -> list[_Vote]:
        """Return the votes of accepted matches."""
        return [vote for vote in self.votes if vote.accepted]

    @property
    def strong(self) -> bool:
        """Return whether a strong match votes for the place."""
        return any(vote.match.validation.strength == "strong" for vote in self.votes)

    @property
    def score(self) -> float:
        """Return how well the pose fits the map; 0 without a map."""
        return 0.0 if self.evidence is None else self.evidence.score


#: Function that, for a parent frame and poses (n, 4, 4) in it, returns the map's frames that may
#: see the same surfaces.
ViewsOf = Callable[[str, Floats], MapViews]

_NONE = np.empty((0, 4, 4))


def model_parameters(frames: Sequence[QueryFrame]) -> LocalizationParameters:
    """Return the localization parameters of the query's model; see `answer_parameters`."""
    return LocalizationParameters.of(answer_parameters(frames[0].geometry))


def judge_places(
    frames: Sequence[QueryFrame], poses: Sequence[Floats] | Mapping[int, Floats],
    parents: Sequence[str] | Mapping[int, str] | None, views_of: ViewsOf | None,
    prior: PosePrior | None, p: LocalizationParameters, overlap_p: OverlapParameters,
) -> tuple[str, PosePrior | None, list[Place]]:  # fmt: skip
    """Return all places that a match, the map or the prior suggests, with the evidence for each.

    Parameters
    ----------
    frames, poses, parents, views_of, prior, p, overlap_p : arguments of `localize`

    Returns
    -------
    parent : parent frame in which poses are compared
    prior : the argument, or None if it is in another parent frame
    places : places with votes first, then by score
    """
    parent = _select_parent(frames, parents)
    if prior is not None and prior.parent != parent:
        if _has_accepted(frames, parents, parent) and not _has_accepted(
            frames, parents, prior.parent
        ):
            prior = None  # a prior has no meaning in another parent frame
        else:
            parent = prior.parent
    own = [
        replace(frame, matches=[
            m for m in frame.matches if parents is None or parents[m.index] == parent
        ])
        for frame in frames
    ]  # fmt: skip
    suggested = _suggest_poses(own, poses)
    votes = _collect_votes(own, poses, p)
    if views_of is None or (not len(suggested.T) and prior is None):
        return parent, prior, [_make_place(group, None, p) for group in _group_votes(votes, [], p)]
    ready = [map_frame(frame.geometry, frame.T, p.map, overlap_p) for frame in frames]
    starts = _NONE if prior is None else prior_starts(prior.T, prior.covariance, p.map)
    views = views_of(parent, np.concatenate([starts[:1], suggested.T]))
    near = refine_starts(ready, starts, views, p.map, overlap_p)
    scored = compare_poses(ready, np.concatenate([near, suggested.T]), views, p.map, overlap_p)
    return parent, prior, _combine_places(votes, scored, suggested, views, p)


def _select_parent(
    frames: Sequence[QueryFrame], parents: Sequence[str] | Mapping[int, str] | None
) -> str:
    """Return the parent frame with the most strong (then accepted, then validated) matches."""
    counts: dict[str, tuple[int, int, int]] = {}
    for frame in frames:
        for match in frame.matches:
            name = "" if parents is None else parents[match.index]
            strong, accepted, tried = counts.get(name, (0, 0, 0))
            v = match.validation
            counts[name] = (
                strong + (v.strength == "strong"), accepted + (v.status == "accepted"), tried + 1
            )  # fmt: skip
    return max(counts, key=counts.__getitem__, default="")


def _has_accepted(
    frames: Sequence[QueryFrame], parents: Sequence[str] | Mapping[int, str] | None, parent: str
) -> bool:
    return any(
        match.validation.status == "accepted"
        and ("" if parents is None else parents[match.index]) == parent
        for frame in frames
        for match in frame.matches
    )


@dataclass(frozen=True, eq=False)
class _Suggestions:
    """Poses that candidates suggest: each candidate's best pose first, then the next best poses.

    Parameters
    ----------
    T : (n, 4, 4) T_parent_query
    viewpoints : (n, 4, 4) T_parent_sensor of the candidates
    similarities : (n,) similarities between the candidates' signatures and the query's
    distinctness : (n,) see PairValidation; 0 for all but each candidate's best pose
    """

    T: Floats
    viewpoints: Floats
    similarities: Floats
    distinctness: Floats


def _suggest_poses(
    frames: Sequence[QueryFrame], poses: Sequence[Floats] | Mapping[int, Floats]
) -> _Suggestions:
    of_match = [
        (match, poses[match.index] @ match.validation.hypotheses @ inverse(frame.T))
        for frame in frames
        for match in frame.matches
        # a transform that contradicts `up` does not suggest a pose
        if len(match.validation.hypotheses) and not match.validation.contradicts_up
    ]
    most = max((len(hypotheses) for _, hypotheses in of_match), default=0)
    ranked = [
        (hypotheses[rank], match, 0.0 if rank else match.validation.distinctness)
        for rank in range(most)
        for match, hypotheses in of_match
        if rank < len(hypotheses)
    ]
    return _Suggestions(
        np.array([T for T, _, _ in ranked]).reshape(-1, 4, 4),
        np.array([poses[match.index] for _, match, _ in ranked]).reshape(-1, 4, 4),
        np.array([match.similarity for _, match, _ in ranked]),
        np.array([distinctness for _, _, distinctness in ranked]),
    )


def _collect_votes(
    frames: Sequence[QueryFrame], poses: Sequence[Floats] | Mapping[int, Floats],
    p: LocalizationParameters,
) -> list[_Vote]:  # fmt: skip
    """Return the votes of accepted matches of all frames, best first, then of ambiguous matches."""
    votes: list[_Vote] = []
    for frame in frames:
        ahead = np.array([looks_ahead(frame.geometry)])
        first = rank_accepted([match.validation for match in frame.matches])
        unsure = [i for i, m in enumerate(frame.matches) if m.validation.status == "ambiguous"]
        for match in [frame.matches[i] for i in [*first, *unsure]]:
            v, viewpoint = match.validation, poses[match.index]
            if v.T_match_query is None:
                continue
            sensor = viewpoint @ v.T_match_query
            T = sensor @ inverse(frame.T)
            covariance = v.covariance
            if covariance is not None:
                lever = T[:3, 3] - sensor[:3, 3]
                covariance = transform_covariance(covariance, viewpoint[:3, :3], lever)
            weight = 1.0 if v.strength == "strong" else p.weak
            (apart,) = view_separations(viewpoint[None], ahead, sensor, bool(ahead[0]), p.map)
            votes.append(_Vote(match, T, covariance, viewpoint, float(apart), weight))
    if len(frames) > 1:
        order = rank_accepted([vote.match.validation for vote in votes])
        votes = [votes[i] for i in order] + [vote for vote in votes if not vote.accepted]
    return votes


def _group_votes(
    votes: Sequence[_Vote], scored: Sequence[ScoredPose], p: LocalizationParameters
) -> list[list[_Vote]]:
    """Group votes by place: return one list per scored pose, in order, then one per other place."""
    groups: list[list[_Vote]] = [[] for _ in scored]
    others: list[list[_Vote]] = []
    for vote in votes:
        group = next(
            (own for own, pose in zip(groups, scored, strict=True) if pose.is_of(vote.T, p.map)),
            next((own for own in others if same_place(own[0].T, vote.T, p.map)), None),
        )
        if group is None:
            others.append(group := [])
        group.append(vote)
    return groups + others


def _combine_places(
    votes: Sequence[_Vote], scored: Sequence[ScoredPose], suggested: _Suggestions,
    views: MapViews, p: LocalizationParameters,
) -> list[Place]:  # fmt: skip
    """Return the places of all votes and scored poses, with the evidence for each."""
    groups = _group_votes(votes, scored, p)
    weights = [_count_votes(group, p)[1] for group in groups]
    scores = [pose.score for pose in scored]
    places = []
    for k, group in enumerate(groups):
        pose = scored[k] if k < len(scored) else None
        others = scores[:k] + scores[k + 1 :]
        evidence = _place_evidence(
            group, pose, suggested, views,
            max(others, default=0.0), max(weights[:k] + weights[k + 1 :], default=0.0), p,
        )  # fmt: skip
        places.append(_make_place(group, pose, p, evidence))
    return sorted(places, key=lambda place: not place.votes)


def _make_place(
    group: list[_Vote], pose: ScoredPose | None, p: LocalizationParameters,
    evidence: PlaceEvidence | None = None,
) -> Place:  # fmt: skip
    """Return the place of a group of votes, of a scored pose, or of both."""
    accepted = any(vote.accepted for vote in group)
    T = group[0].T if pose is None or accepted else pose.T
    support, weight = _count_votes(group, p)
    return Place(T, group, support, weight, evidence)


def _count_votes(group: Sequence[_Vote], p: LocalizationParameters) -> tuple[int, float]:
    """Return the number of voting viewpoints, and the total weight of the first vote from each.

    Guided matches do not count.
    """
    voting = [vote for vote in group if not vote.match.validation.guided]
    viewpoints = np.array([vote.viewpoint for vote in voting]).reshape(-1, 4, 4)
    different = distinct_viewpoints(viewpoints, p.map)
    return len(different), sum(voting[i].weight for i in different)


def _place_evidence(
    group: Sequence[_Vote], pose: ScoredPose | None, suggested: _Suggestions,
    views: MapViews, rival: float, rival_weight: float, p: LocalizationParameters,
) -> PlaceEvidence:  # fmt: skip
    """Compute the evidence for a place from its votes and its pose on the map.

    Parameters
    ----------
    group : votes for the place
    pose : scored pose of the place; None if no pose was scored there
    suggested : result of `_suggest_poses`
    views : the map's frames
    rival, rival_weight : maximum score of another place, and maximum weight of another place
    """
    weight = _count_votes(group, p)[1]
    strong = _count_votes([v for v in group if v.match.validation.strength == "strong"], p)[0]
    leading = np.array([v.viewpoint for v in group if v.accepted]).reshape(-1, 4, 4)
    accepted = len(distinct_viewpoints(leading, p.map))
    T = group[0].T if pose is None else pose.T
    here = at_place(suggested.T, T, p.map)
    suggesting = len(distinct_viewpoints(suggested.viewpoints[here], p.map))
    similarity = float(suggested.similarities[here].max(initial=0.0))
    distinctness = float(suggested.distinctness[here].max(initial=0.0))
    if pose is None:
        return PlaceEvidence(
            0.0, 0.0, 0.0, 0, 0, 1.0, weight, strong, accepted, suggesting, similarity,
            1.0, rival_weight, distinctness, views.mostly_rendered(()),
        )  # fmt: skip
    agreeing = np.unique([i for _, i in pose.views]).astype(np.intp)
    seen_from = len(distinct_viewpoints(views.poses[agreeing], p.map))
    excess = pose.violations + pose.hidden - min(pose.noise, p.most_noise)
    ratio = max(rival, 0.0) / pose.score if pose.score > 0 else 1.0
    return PlaceEvidence(
        pose.score, pose.share, pose.planes, len(agreeing), seen_from, excess, weight, strong,
        accepted, suggesting, similarity, ratio, rival_weight, distinctness,
        views.mostly_rendered(agreeing),
    )  # fmt: skip
