"""Verification in the map: compare poses of a query on all frames that would see its surfaces.

    query, poses, MapViews  --compare_poses-->  ScoredPose, the best of each place first

Two frames can agree under a wrong transform: a cabinet looks alike from both sides. The frames
around it then tell the poses apart, as each shows what the query would have to see from there.
So a pose is scored on many views at once. A surface of the query that one view does not show
another may, and what most of the views saw through speaks against the pose.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.registration.icp import COARSE, RefinementParameters
from sceneprint.geometry.registration.overlap import (
    AGREES,
    VIOLATES,
    LookupTarget,
    OverlapParameters,
    PlaneParameters,
    PlaneView,
    look_up,
    overlap_target,
    plane_view,
    tolerances,
)
from sceneprint.geometry.rigid import are_near, average_poses, inverse, select_distinct
from sceneprint.geometry.validation.validation import refined_at
from sceneprint.types import Floats, Geometry, Intrinsics


@dataclass(frozen=True)
class MapParameters:
    """The numbers of verification in the map."""

    n_views: int = 10  #: that a pose is scored on, at most
    look_ahead: float = 1.5  #: of a camera, to the middle of what it sees, metres
    reach: float = 3.5  #: between the middles of two views that may share surfaces, metres
    around_reach: float = 4.0  #: the same where a sensor may look anywhere, metres
    same_surfaces: float = 8.0  #: between two sensors that may still see the same surfaces, metres
    near: float = 2.0  #: within which frames of the map are looked for first, metres
    cell: float = 1.0  #: poses this near are looked about once, metres
    start_shift: float = 0.5  #: from a prior to the starts about it, at most, metres
    least_agreeing: float = 0.03  #: share of the query's points, below which a view has no say
    violation_weight: float = 2.0  #: of the violations of either side, in the score
    n_poses: int = 40  #: that are scored on the candidates
    n_places: int = 6  #: places, the best of these, that are scored on all frames
    hopeful: float = 0.2  #: of the best score, below which a place is not looked into further
    n_refined: int = 3  #: places whose pose is refined
    n_refining: int = 3  #: views that a pose is refined on
    n_noise: int = 4  #: frames of the map whose own violations are taken for noise
    least_noise: float = 0.02  #: violations of a pose below which that is not asked
    same_m: float = 0.1  #: poses this near are one, metres
    same_rad: float = math.radians(6.0)
    place_m: float = 0.25  #: poses farther apart are of two places, metres
    place_rad: float = math.radians(15.0)
    refinement: RefinementParameters = COARSE
    planes: PlaneParameters = field(default_factory=PlaneParameters)


@dataclass(frozen=True, eq=False)
class MapFrame:
    """A frame with a pose, prepared for scoring other poses on it.

    Parameters
    ----------
    geometry : of the frame
    target : its surface, to be looked up
    T : (4, 4) T_parent_sensor; of a frame of the query T_query_sensor
    weighing : which of its patches lie in one plane
    """

    geometry: Geometry
    target: LookupTarget
    T: Floats
    weighing: PlaneParameters

    @cached_property
    def planes(self) -> PlaneView:
        """Its patches with their weights, when they are first needed."""
        return plane_view(self.geometry, self.weighing)

    @cached_property
    def inverse_pose(self) -> Floats:
        """(4, 4), the inverse of T: many poses are scored on one frame."""
        return inverse(self.T)


@dataclass(frozen=True, eq=False)
class ScoredPose:
    """A pose of the query with its score on the map's frames.

    Parameters
    ----------
    T : (4, 4) T_parent_query
    score : `share`, less for violations; 1 where all that the query sees is in the map
    share : of the query's surface that the map shows there, every plane counting the same
    planes : distinct planes of a frame of the query that agree, on average
    violations : share of the query's surface that the map saw through, of what is decided
    hidden : the same of the map's surfaces, which the query saw through
    noise : violations that the map's frames about the pose show among themselves; 0 where it
        was not asked for
    views : frames of the query with positions of map frames that agree, most shared first
    starts : (4, 4) poses that were refined to this one, or to its place
    """

    T: Floats
    score: float
    share: float
    planes: float
    violations: float
    hidden: float
    views: tuple[tuple[int, int], ...]
    noise: float = 0.0
    starts: tuple[Floats, ...] = ()

    def is_of(self, T: Floats, p: MapParameters) -> bool:
        """Return whether a pose (4, 4) is at this place, or at one that was refined to it."""
        return bool(at_place(np.stack([self.T, *self.starts]), T, p).any())


class MapViews:
    """The frames of one parent frame that may see what a query sees, opened when needed."""

    def __init__(
        self, poses: Floats, open_geometry: Callable[[int], Geometry | None],
        p: MapParameters, overlap_p: OverlapParameters, candidates: Sequence[int] = (),
        ahead: Sequence[bool] | None = None, rendered: Sequence[bool] | None = None,
    ) -> None:  # fmt: skip
        """Hold frames by their poses.

        Parameters
        ----------
        poses : (n, 4, 4) T_parent_sensor
        open_geometry : the artifact of the i-th; None where it cannot be read
        p, overlap_p : see there
        candidates : positions of those that poses are first compared on, being open already;
            none: all
        ahead : of each, whether its sensor looks along z, as depth cameras do; default: all do
        rendered : of each, whether it is a view rendered from a surface; default: none is
        """
        self.poses, self._open, self._p, self._overlap = poses, open_geometry, p, overlap_p
        self.candidates = np.array(candidates, np.intp)
        self._ahead = np.ones(len(poses), bool) if ahead is None else np.array(ahead, bool)
        self._rendered = np.array([False] * len(poses) if rendered is None else rendered, bool)
        self._frames: dict[int, MapFrame | None] = {}

    def __getitem__(self, i: int) -> MapFrame | None:
        """Return the i-th frame, or None where its artifact cannot be read."""
        if i not in self._frames:
            geometry = self._open(i)
            self._frames[i] = None if geometry is None else map_frame(
                geometry, self.poses[i], self._p, self._overlap
            )  # fmt: skip
        return self._frames[i]

    def mostly_rendered(self, frames: Sequence[int] | NDArray[np.intp]) -> bool:
        """Return whether more than half of some frames are views rendered from a surface.

        Of all, where none is named.
        """
        among = self._rendered[list(frames)] if len(frames) else self._rendered
        return 2 * int(among.sum()) > len(among)

    def near(self, T: Floats, ahead: bool, among: NDArray[np.intp] | None = None) -> list[int]:
        """Return the frames that most likely see what a sensor at T sees, nearest first.

        Parameters
        ----------
        T : (4, 4) T_parent_sensor
        ahead : whether it looks along z; where both sensors do, directions count beside distance
        among : positions of the frames to choose from; default: all
        """
        p = self._p
        poses = self.poses if among is None else self.poses[among]
        look_ahead = self._ahead if among is None else self._ahead[among]
        apart = view_separations(poses, look_ahead, T, ahead, p)
        order = np.argsort(apart, kind="stable")[: p.n_views]
        order = order[apart[order] < 1.0]
        near: list[int] = (order if among is None else among[order]).tolist()
        return near


def map_frame(
    geometry: Geometry, T: Floats, p: MapParameters, overlap_p: OverlapParameters
) -> MapFrame:
    """Return a frame prepared for comparison with others of its parent frame.

    Parameters
    ----------
    geometry : of the frame
    T : (4, 4), see MapFrame
    p, overlap_p : see there
    """
    target = overlap_target(geometry.surface, overlap_p)
    return MapFrame(geometry, target, T, p.planes)


def looks_ahead(geometry: Geometry) -> bool:
    """Return whether the sensor looks along z, as depth cameras do.

    Clouds may have any axes, and many scanners see all around.
    """
    return isinstance(geometry.surface.camera, Intrinsics)


def view_separations(
    poses: Floats, look_ahead: NDArray[np.bool_], T: Floats, ahead: bool, p: MapParameters
) -> Floats:
    """Return how far the views of sensors are from that of a sensor at T: (n,).

    Views at 1 or more are too far apart to share surfaces.

    Parameters
    ----------
    poses : (n, 4, 4) T_parent_sensor
    look_ahead : (n,) whether each looks along z
    T, ahead : (4, 4) of the one sensor, and whether it does; where both do, directions count
        beside distance
    p : see there
    """
    axes = poses[:, :3, 2]
    middles = poses[:, :3, 3] + np.where(look_ahead, p.look_ahead, 0.0)[:, None] * axes
    own = T[:3, 3] + (p.look_ahead if ahead else 0.0) * T[:3, 2]
    apart: Floats = np.linalg.norm(middles - own, axis=1)
    both = look_ahead & ahead
    apart += np.where(both, p.look_ahead * (1.0 - axes @ T[:3, 2]), 0.0)
    return apart / np.where(both, p.reach, p.around_reach)


def score_pose(
    frames: Sequence[MapFrame], T: Floats, views: MapViews, p: MapParameters,
    overlap_p: OverlapParameters, among: NDArray[np.intp] | None = None,
) -> ScoredPose:  # fmt: skip
    """Score a pose of the query on the map's frames.

    Parameters
    ----------
    frames : of the query, of `map_frame`: each with its T_query_sensor, the identity for one
    T : (4, 4) T_parent_query
    views : of the same parent frame
    p, overlap_p : see there
    among : positions of the frames that it is scored on; default: all
    """
    limits = tolerances(overlap_p)
    total = agreeing = violating = seen = through = 0.0
    shared: list[tuple[int, int, int]] = []
    for number, frame in enumerate(frames):
        points, weights = frame.planes.points, frame.planes.weights
        agree, violate = np.zeros(len(points), np.int32), np.zeros(len(points), np.int32)
        T_parent_sensor = T @ frame.T
        for i in views.near(T_parent_sensor, looks_ahead(frame.geometry), among):
            view = views[i]
            if view is None:
                continue
            T_view_sensor = view.inverse_pose @ T_parent_sensor
            said = look_up(points, view.target, T_view_sensor, limits)
            agreed = said == AGREES
            count = int(np.count_nonzero(agreed))
            agree += agreed
            violate += said == VIOLATES
            if count < p.least_agreeing * len(points):
                continue
            shared.append((-count, number, i))
            back = look_up(view.planes.points, frame.target, inverse(T_view_sensor), limits)
            seen += float(view.planes.weights[back == AGREES].sum(dtype=float))
            through += float(view.planes.weights[back == VIOLATES].sum(dtype=float))
        total += float(weights.sum(dtype=float))
        agreeing += float(weights[agree > violate].sum(dtype=float))
        violating += float(weights[violate > agree].sum(dtype=float))
    share = agreeing / max(total, 1e-9)
    violations = violating / max(agreeing + violating, 1e-9)
    hidden = through / max(seen + through, 1e-9)
    score = share * (1.0 - p.violation_weight * (violations + hidden))
    pairs = tuple((number, i) for _, number, i in sorted(shared))
    return ScoredPose(T, score, share, agreeing / len(frames), violations, hidden, pairs)


def map_noise(
    pose: ScoredPose, views: MapViews, p: MapParameters, overlap_p: OverlapParameters
) -> float:
    """Return the median violations among the map's frames that agree with a pose.

    Poses that drift and things that were moved let free space speak against right poses too.

    Parameters
    ----------
    pose : of `score_pose`
    views, p, overlap_p : see there
    """
    noises = []
    agreeing = np.unique([i for _, i in pose.views])
    for _, i in pose.views[: p.n_noise]:
        view = views[i]
        if view is not None:
            alone = replace(view, T=np.eye(4))
            own = score_pose([alone], view.T, views, p, overlap_p, agreeing[agreeing != i])
            noises.append(own.violations + own.hidden)
    return float(np.median(noises)) if noises else 0.0


def refined_pose(
    frames: Sequence[MapFrame], pose: ScoredPose, views: MapViews, p: MapParameters
) -> Floats | None:
    """Return a pose refined on the views that share most with it, and averaged: (4, 4), or None."""
    refined = []
    for number, i in pose.views[: p.n_refining]:
        frame, view = frames[number], views[i]
        if view is None:
            continue
        start = inverse(view.T) @ pose.T @ frame.T
        T = refined_at(frame.geometry, view.geometry, start, p.refinement)
        if T is not None:
            refined.append(view.T @ T @ inverse(frame.T))
    return average_poses(np.stack(refined)).T if refined else None


def starts_about(T: Floats, covariance: Floats, p: MapParameters) -> Floats:
    """Return a pose and six about it, a deviation away along each axis: (7, 4, 4).

    Parameters
    ----------
    T : (4, 4) T_parent_sensor that is believed
    covariance : (6, 6) of it, metres before radians
    p : shifts are `p.start_shift` at most, as refinement bridges no more
    """
    starts = np.tile(T, (7, 1, 1))
    deviations = np.minimum(np.sqrt(np.diag(covariance)[:3]), p.start_shift)
    for axis in range(3):
        starts[1 + 2 * axis, axis, 3] += deviations[axis]
        starts[2 + 2 * axis, axis, 3] -= deviations[axis]
    return starts


def refined_starts(
    frames: Sequence[MapFrame], starts: Floats, views: MapViews, p: MapParameters,
    overlap_p: OverlapParameters,
) -> Floats:  # fmt: skip
    """Return poses of a prior (n, 4, 4) after refinement on the map: (m, 4, 4)."""
    refined = []
    for start in starts:
        T = refined_pose(frames, score_pose(frames, start, views, p, overlap_p), views, p)
        if T is not None:
            refined.append(T)
    return np.array(refined).reshape(-1, 4, 4)


def compare_poses(
    frames: Sequence[MapFrame], poses: Floats, views: MapViews, p: MapParameters,
    overlap_p: OverlapParameters,
) -> list[ScoredPose]:  # fmt: skip
    """Return poses of the query, the best of each place, best first.

    All are compared on the candidates first, and the best places on all frames that would see them.
    The first few places are refined on the map before they are compared, as a pose that is off
    by a few centimetres shows violations that the right one has not.

    Parameters
    ----------
    frames : of the query, as in `score_pose`
    poses : (n, 4, 4) T_parent_query, those to believe most first; beyond `n_poses` distinct ones
        the rest is left out
    views : of the same parent frame
    p, overlap_p : see there
    """
    first = -np.arange(len(poses), dtype=float)
    chosen = select_distinct(poses, first, p.same_m, p.same_rad, p.n_poses)
    among = views.candidates if len(views.candidates) else None
    scored = [score_pose(frames, poses[i], views, p, overlap_p, among) for i in chosen]
    places = _hopeful(best_of_places(scored, p), p)[: p.n_places]
    scored = [score_pose(frames, place.T, views, p, overlap_p) for place in places]
    places = _refined_places(frames, best_of_places(scored, p), views, p, overlap_p)
    for k, pose in enumerate(places[: p.n_refined]):
        if pose.violations + pose.hidden > p.least_noise:
            places[k] = replace(pose, noise=map_noise(pose, views, p, overlap_p))
    return places


def _refined_places(
    frames: Sequence[MapFrame], places: list[ScoredPose], views: MapViews, p: MapParameters,
    overlap_p: OverlapParameters,
) -> list[ScoredPose]:  # fmt: skip
    """Refine places, best first, until `n_refined` different ones are left: best first.

    A pose that refines to a better one is no other place: it started in the same basin, and would
    pass for a rival of what it leads to.
    """
    hopeful = _hopeful(places, p)
    settled: list[ScoredPose] = []
    for pose in hopeful:
        if len(settled) == p.n_refined:
            break
        T = refined_pose(frames, pose, views, p)
        refined = pose if T is None else score_pose(frames, T, views, p, overlap_p)
        near = [same_place(one.T, refined.T, p) for one in settled]
        if any(near):
            k = near.index(True)
            best = max(settled[k], refined, key=lambda one: one.score)
            settled[k] = replace(best, starts=(*settled[k].starts, pose.T))
            continue
        best = max(pose, refined, key=lambda one: one.score)
        settled.append(replace(best, starts=(pose.T,)))
    own = np.array([T for one in settled for T in (one.T, *one.starts)]).reshape(-1, 4, 4)
    rest = [one for one in places if not at_place(own, one.T, p).any()]
    return best_of_places([*settled, *rest], p)


def _hopeful(places: list[ScoredPose], p: MapParameters) -> list[ScoredPose]:
    """Return the places whose score may still come near that of the first, which is the best."""
    return [one for one in places if one is places[0] or one.score >= p.hopeful * places[0].score]


def best_of_places(scored: list[ScoredPose], p: MapParameters) -> list[ScoredPose]:
    """Return the best pose of each place, best first; ties keep their order."""
    places: list[ScoredPose] = []
    for one in sorted(scored, key=lambda pose: -pose.score):
        if not places or not at_place(np.stack([other.T for other in places]), one.T, p).any():
            places.append(one)
    return places


def same_place(a: Floats, b: Floats, p: MapParameters) -> bool:
    """Return whether two poses (4, 4) are at one place."""
    return bool(at_place(a[None], b, p)[0])


def at_place(poses: Floats, T: Floats, p: MapParameters) -> NDArray[np.bool_]:
    """Return which of some poses (n, 4, 4) are at the place of T: (n,)."""
    return are_near(poses, T, p.place_m, p.place_rad)


def different_views(viewpoints: Floats, p: MapParameters) -> list[int]:
    """Return the indices of the first of some views (n, 4, 4) from each viewpoint."""
    order = -np.arange(len(viewpoints), dtype=float)
    return select_distinct(viewpoints, order, p.same_m, p.same_rad, len(viewpoints))
