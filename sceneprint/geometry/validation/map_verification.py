"""Comparison of candidate poses on all frames of the map that would see the query's surfaces.

    query, poses, MapViews  --compare_poses-->  ScoredPose of each place, best first

Two frames can agree under a wrong transform: a cabinet can look the same from both sides. Other
frames around it distinguish the poses, because each pose predicts what the query would observe.
Therefore, a pose is scored on many views: only some may see a given surface of the query, but free
space in most of them contradicts a wrong pose.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.registration.icp import COARSE, RefinementParameters
from sceneprint.geometry.registration.overlap import (
    LookupTarget,
    OverlapParameters,
    PlaneParameters,
    PlaneView,
    count_verdicts,
    overlap_target,
    plane_view,
    tolerances,
    weigh_overlap,
)
from sceneprint.geometry.rigid import are_near, average_poses, inverse, select_distinct
from sceneprint.geometry.validation.validation import refine_transform
from sceneprint.types import Floats, Geometry, Intrinsics


@dataclass(frozen=True)
class MapParameters:
    """Parameters of verification in the map."""

    n_views: int = 10  #: maximum number of views that score a pose
    look_ahead: float = 1.5  #: distance from a camera to the centre of its view, metres
    reach: float = 3.5  #: maximum distance between the centres of overlapping views, metres
    around_reach: float = 4.0  #: `reach` if a sensor may look in any direction, metres
    same_surfaces: float = 8.0  #: maximum distance between sensors with common surfaces, metres
    near: float = 2.0  #: radius of the first search for frames of the map, metres
    cell: float = 1.0  #: poses closer than this share a search for frames, metres
    start_shift: float = 0.5  #: maximum distance between an initial pose and its prior, metres
    least_agreeing: float = 0.03  #: minimum share of agreeing points for a view to count
    violation_weight: float = 2.0  #: weight of the violations of either side in the score
    n_poses: int = 40  #: number of poses that are scored on the candidate frames
    n_places: int = 6  #: number of best places that are scored on all frames
    hopeful: float = 0.2  #: minimum score of a place to refine, as a share of the best score
    n_refined: int = 3  #: number of places to refine
    n_refining: int = 3  #: number of views on which a pose is refined
    n_noise: int = 4  #: number of map frames among which noise is measured
    least_noise: float = 0.02  #: share of violations above which noise is measured
    same_m: float = 0.1  #: maximum difference between equal poses, metres
    same_rad: float = math.radians(6.0)  #: maximum difference between equal poses, radians
    place_m: float = 0.25  #: maximum difference between poses at a place, metres
    place_rad: float = math.radians(15.0)  #: maximum difference between poses at a place, radians
    refinement: RefinementParameters = COARSE
    planes: PlaneParameters = field(default_factory=PlaneParameters)


@dataclass(frozen=True, eq=False)
class MapFrame:
    """A frame with a known pose, prepared for scoring poses of a query.

    Parameters
    ----------
    geometry : geometry of the frame
    target : surface of the frame, prepared for look-ups
    T : (4, 4) T_parent_sensor; T_query_sensor for a frame of the query
    weighing : limits within which patches lie in the same plane
    """

    geometry: Geometry
    target: LookupTarget
    T: Floats
    weighing: PlaneParameters

    @cached_property
    def planes(self) -> PlaneView:
        """Return the patches of the frame with their weights."""
        return plane_view(self.geometry, self.weighing)

    @cached_property
    def inverse_pose(self) -> Floats:
        """Return the inverse of T, (4, 4)."""
        return inverse(self.T)


@dataclass(frozen=True, eq=False)
class ScoredPose:
    """A pose of the query, with its score on the map's frames.

    Parameters
    ----------
    T : (4, 4) T_parent_query
    score : `share` reduced by violations; 1 if the map confirms the whole query
    share : share of the query's surface that the map shows at the pose, with equal weights for all
        planes
    planes : mean number of distinct planes of a query frame that agree
    violations : violations as a share of agreements and violations, for the query's surface
    hidden : share of the map's surfaces that violate the query's free space
    noise : share of violations among the map's frames at the pose; 0 if unmeasured
    views : indices (query frame, map frame) of the pairs that agree, by descending agreement
    starts : (4, 4) initial poses whose refinement led to this pose or its place
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
        """Return whether a pose (4, 4) is at this place, or near one of its `starts`."""
        return bool(at_place(np.stack([self.T, *self.starts]), T, p).any())


class MapViews:
    """The frames of a parent frame that may see the surfaces of a query; opened on demand."""

    def __init__(
        self, poses: Floats, open_geometry: Callable[[int], Geometry | None],
        p: MapParameters, overlap_p: OverlapParameters, candidates: Sequence[int] = (),
        ahead: Sequence[bool] | None = None, rendered: Sequence[bool] | None = None,
    ) -> None:  # fmt: skip
        """Store the poses of frames, and how to open the frames.

        Parameters
        ----------
        poses : (n, 4, 4) T_parent_sensor
        open_geometry : function that returns the artifact of frame i, or None if it is unreadable
        candidates : indices of the frames for the first comparison; if empty, it uses all frames
        ahead : whether each sensor looks along z, as depth cameras do; None if all do
        rendered : whether each frame is a view rendered from a surface; None if none is
        """
        self.poses, self._open, self._p, self._overlap = poses, open_geometry, p, overlap_p
        self.candidates = np.array(candidates, np.intp)
        self._ahead = np.ones(len(poses), bool) if ahead is None else np.array(ahead, bool)
        self._rendered = np.array([False] * len(poses) if rendered is None else rendered, bool)
        self._frames: dict[int, MapFrame | None] = {}

    def __getitem__(self, i: int) -> MapFrame | None:
        """Return frame i; None if its artifact is unreadable."""
        if i not in self._frames:
            geometry = self._open(i)
            self._frames[i] = None if geometry is None else map_frame(
                geometry, self.poses[i], self._p, self._overlap
            )  # fmt: skip
        return self._frames[i]

    def mostly_rendered(self, frames: Sequence[int] | NDArray[np.intp]) -> bool:
        """Return whether most of `frames` (if empty, of all frames) are rendered views."""
        among = self._rendered[list(frames)] if len(frames) else self._rendered
        return 2 * int(among.sum()) > len(among)

    def near(self, T: Floats, ahead: bool, among: NDArray[np.intp] | None = None) -> list[int]:
        """Return the frames that most likely see what a sensor at T sees, nearest view first.

        Parameters
        ----------
        T : (4, 4) T_parent_sensor
        ahead : whether the sensor looks along z; if so, its direction is compared with those of
            other such sensors
        among : indices of the frames to search; None searches all frames
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
    """Prepare a frame for comparison with other frames; `T` becomes `MapFrame.T`."""
    target = overlap_target(geometry.surface, overlap_p)
    return MapFrame(geometry, target, T, p.planes)


def looks_ahead(geometry: Geometry) -> bool:
    """Return whether the sensor looks along z, as depth cameras do.

    Clouds have arbitrary axes, and many scanners see all around.
    """
    return isinstance(geometry.surface.camera, Intrinsics)


def view_separations(
    poses: Floats, look_ahead: NDArray[np.bool_], T: Floats, ahead: bool, p: MapParameters
) -> Floats:
    """Return the separations (n,) between the views of sensors and the view of a sensor at T.

    Views with a separation of 1 or more are too far apart to show the same surfaces.

    Parameters
    ----------
    poses : (n, 4, 4) T_parent_sensor
    look_ahead : (n,) mask of the sensors that look along z
    T, ahead : (4, 4) pose of the sensor, and whether it looks along z; if both sensors do, their
        directions are compared too
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
    frames : results of `map_frame` for the query, with T_query_sensor (the identity for a single
        frame)
    T : (4, 4) T_parent_query
    views : views of the same parent frame
    among : indices of the frames on which the pose is scored; None selects all frames
    """
    limits = tolerances(overlap_p)
    total = agreeing = violating = seen = through = 0.0
    shared: list[tuple[int, int, int]] = []
    for number, frame in enumerate(frames):
        points, weights, own = frame.planes.points, frame.planes.weights, frame.target
        agree, violate = np.zeros((2, len(points)), np.int32)
        T_parent_sensor = T @ frame.T
        for i in views.near(T_parent_sensor, looks_ahead(frame.geometry), among):
            view = views[i]
            if view is None:
                continue
            T_view_sensor = view.inverse_pose @ T_parent_sensor
            count = count_verdicts(points, *view.target, T_view_sensor, limits, agree, violate)
            if count < p.least_agreeing * len(points):
                continue
            shared.append((-count, number, i))
            back = inverse(T_view_sensor)
            inliers, violations = weigh_overlap(
                view.planes.points, view.planes.weights, *own, back, limits
            )
            seen += inliers
            through += violations
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
    """Return the median share of violations among the map frames that agree with a pose.

    Drift of poses, and moved objects, cause violations even at correct poses.
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


def refine_pose(
    frames: Sequence[MapFrame], pose: ScoredPose, views: MapViews, p: MapParameters
) -> Floats | None:
    """Refine a pose on its best views; return the average (4, 4), or None if all views fail."""
    refined = []
    for number, i in pose.views[: p.n_refining]:
        frame, view = frames[number], views[i]
        if view is None:
            continue
        start = inverse(view.T) @ pose.T @ frame.T
        T = refine_transform(frame.geometry, view.geometry, start, p.refinement)
        if T is not None:
            refined.append(view.T @ T @ inverse(frame.T))
    return average_poses(np.stack(refined)).T if refined else None


def median_contradiction(
    frames: Iterable[tuple[Geometry, Floats]], views: MapViews, p: MapParameters,
    overlap_p: OverlapParameters,
) -> float:  # fmt: skip
    """Return the median share of a frame's surfaces that contradict the map at its pose.

    Between two places that look alike, some pairs of frames agree, but most frames show surfaces
    where the other place has free space. Poses are refined first, because maps drift.

    Parameters
    ----------
    frames : geometries with their poses (4, 4) in the parent frame of `views`; a frame that agrees
        with no frame of the map is ignored

    Returns
    -------
    median of the mean violations of both sides, minus those among the map's frames; 0 if no frame
    counts
    """
    shares = []
    for geometry, T in frames:
        frame = map_frame(geometry, np.eye(4), p, overlap_p)
        pose = score_pose([frame], T, views, p, overlap_p)
        refined = refine_pose([frame], pose, views, p)
        if refined is not None:
            again = score_pose([frame], refined, views, p, overlap_p)
            pose = max(pose, again, key=lambda scored: scored.score)
        if pose.views:
            noise = map_noise(pose, views, p, overlap_p)
            shares.append((pose.violations + pose.hidden - noise) / 2)
    return float(np.median(shares)) if shares else 0.0


def prior_starts(T: Floats, covariance: Floats, p: MapParameters) -> Floats:
    """Return a pose, and six copies shifted by a standard deviation along the axes, (7, 4, 4).

    Parameters
    ----------
    T : (4, 4) T_parent_sensor of the prior
    covariance : (6, 6) covariance of T, metres before radians
    p : parameters; `start_shift` limits the shifts, so that refinements converge
    """
    starts = np.tile(T, (7, 1, 1))
    deviations = np.minimum(np.sqrt(np.diag(covariance)[:3]), p.start_shift)
    for axis in range(3):
        starts[1 + 2 * axis, axis, 3] += deviations[axis]
        starts[2 + 2 * axis, axis, 3] -= deviations[axis]
    return starts


def refine_starts(
    frames: Sequence[MapFrame], starts: Floats, views: MapViews, p: MapParameters,
    overlap_p: OverlapParameters,
) -> Floats:  # fmt: skip
    """Refine a prior's starts (n, 4, 4) on the map; return the successful results (m, 4, 4)."""
    refined = []
    for start in starts:
        T = refine_pose(frames, score_pose(frames, start, views, p, overlap_p), views, p)
        if T is not None:
            refined.append(T)
    return np.array(refined).reshape(-1, 4, 4)


def compare_poses(
    frames: Sequence[MapFrame], poses: Floats, views: MapViews, p: MapParameters,
    overlap_p: OverlapParameters,
) -> list[ScoredPose]:  # fmt: skip
    """Return the best pose of the query at each place, best first.

    Each pose is scored on the candidate frames, and the best places are scored on all frames that
    would see the same surfaces. The best places are also refined on the map, because an error of a
    few centimetres causes violations.

    Parameters
    ----------
    frames : frames of the query; see `score_pose`
    poses : (n, 4, 4) T_parent_query, most plausible first; at most `n_poses` distinct poses are
        compared
    views : views of the same parent frame
    """
    first = -np.arange(len(poses), dtype=float)
    chosen = select_distinct(poses, first, p.same_m, p.same_rad, p.n_poses)
    among = views.candidates if len(views.candidates) else None
    scored = [score_pose(frames, poses[i], views, p, overlap_p, among) for i in chosen]
    places = _select_hopeful(best_per_place(scored, p), p)[: p.n_places]
    scored = [score_pose(frames, place.T, views, p, overlap_p) for place in places]
    places = _refine_places(frames, best_per_place(scored, p), views, p, overlap_p)
    for k, pose in enumerate(places[: p.n_refined]):
        if pose.violations + pose.hidden > p.least_noise:
            places[k] = replace(pose, noise=map_noise(pose, views, p, overlap_p))
    return places


def _refine_places(
    frames: Sequence[MapFrame], places: list[ScoredPose], views: MapViews, p: MapParameters,
    overlap_p: OverlapParameters,
) -> list[ScoredPose]:  # fmt: skip
    """Refine places until `n_refined` different places are refined; return all, best first.

    Poses that converge to the same result are the same place, and must not count as its rivals.
    """
    hopeful = _select_hopeful(places, p)
    settled: list[ScoredPose] = []
    for pose in hopeful:
        if len(settled) == p.n_refined:
            break
        T = refine_pose(frames, pose, views, p)
        refined = pose if T is None else score_pose(frames, T, views, p, overlap_p)
        near = [same_place(place.T, refined.T, p) for place in settled]
        if any(near):
            k = near.index(True)
            best = max(settled[k], refined, key=lambda place: place.score)
            settled[k] = replace(best, starts=(*settled[k].starts, pose.T))
            continue
        best = max(pose, refined, key=lambda place: place.score)
        settled.append(replace(best, starts=(pose.T,)))
    own = np.array([T for place in settled for T in (place.T, *place.starts)]).reshape(-1, 4, 4)
    rest = [place for place in places if not at_place(own, place.T, p).any()]
    return best_per_place([*settled, *rest], p)


def _select_hopeful(places: list[ScoredPose], p: MapParameters) -> list[ScoredPose]:
    """Return the places that may, once refined, score nearly as well as the first (best) place."""
    return places[:1] + [pose for pose in places[1:] if pose.score >= p.hopeful * places[0].score]


def best_per_place(scored: list[ScoredPose], p: MapParameters) -> list[ScoredPose]:
    """Return the best pose at each place, best first; ties remain in order."""
    places: list[ScoredPose] = []
    for pose in sorted(scored, key=lambda pose: -pose.score):
        if not places or not at_place(np.stack([place.T for place in places]), pose.T, p).any():
            places.append(pose)
    return places


def same_place(a: Floats, b: Floats, p: MapParameters) -> bool:
    """Return whether two poses (4, 4) are at the same place."""
    return bool(at_place(a[None], b, p)[0])


def at_place(poses: Floats, T: Floats, p: MapParameters) -> NDArray[np.bool_]:
    """Return a mask (n,) of the poses (n, 4, 4) at the place of T."""
    return are_near(poses, T, p.place_m, p.place_rad)


def distinct_viewpoints(viewpoints: Floats, p: MapParameters) -> list[int]:
    """Return the index of the first of `viewpoints` (n, 4, 4) at each distinct viewpoint."""
    order = -np.arange(len(viewpoints), dtype=float)
    return select_distinct(viewpoints, order, p.same_m, p.same_rad, len(viewpoints))
