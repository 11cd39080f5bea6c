"""Registration as others do it, beside ours: FPFH with RANSAC or FGR, then ICP, by Open3D.

points, points  --register-->  Attempt of each method

One standard configuration each, not tuned, in one direction; they always answer, and do not say
whether to believe it. Features are counted on both frames.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from sceneprint.types import Floats, Frame

T = TypeVar("T")

#: FPFH as its users run it: voxel, then normals (radius, neighbours), features (the same).
VOXEL, NORMALS, FEATURES = 0.05, (0.10, 30), (0.25, 100)
#: RANSAC: farthest correspondence (metres), points a hypothesis, least ratio of edge lengths, ...
CORRESPONDENCE, POINTS, EDGES = 0.075, 3, 0.9
#: ... hypotheses at the most, and confidence at which it stops.
HYPOTHESES, CONFIDENCE = 100_000, 0.999
#: FGR: farthest correspondence, metres: half a voxel, as its authors' example has it.
FGR_CORRESPONDENCE = 0.025
#: ICP, point to plane: voxel of both clouds, and farthest correspondence, metres.
ICP_VOXEL, ICP_CORRESPONDENCE = 0.02, 0.05
#: What is measured, in the order of the tables.
METHODS = ("FPFH + RANSAC", "FPFH + FGR")
#: Fewer points than this in the thinned cloud are not registered.
_FEWEST = 10


class Clock:
    """Milliseconds by stage."""

    def __init__(self) -> None:
        self.stages: dict[str, float] = {}

    def run(self, stage: str, call: Callable[[], T]) -> T:
        """Time one call and add it to its stage."""
        start = time.perf_counter()
        result = call()
        self.stages[stage] = self.stages.get(stage, 0.0) + 1e3 * (time.perf_counter() - start)
        return result


@dataclass(frozen=True, eq=False)
class Attempt:
    """What one method makes of a pair.

    Parameters
    ----------
    start : (4, 4) T_match_query before ICP
    refined : (4, 4) after ICP
    stages : milliseconds; those of features on both frames
    """

    start: Floats
    refined: Floats
    stages: dict[str, float]

    @property
    def milliseconds(self) -> float:
        """Of all stages."""
        return sum(self.stages.values())


def points_of(frame: Frame, minimum: float, maximum: float) -> Floats:
    """All samples of a depth image within a range, (N, 3) metres."""
    k = frame.intrinsics
    y, x = np.nonzero((frame.depth >= minimum) & (frame.depth <= maximum))
    z = frame.depth[y, x].astype(np.float64)
    return np.stack([(x - k.cx) / k.fx * z, (y - k.cy) / k.fy * z, z], axis=1)


def register(
    query: Floats,
    match: Floats,
    o3d: Any,
    methods: Sequence[str] = METHODS,
    *,
    seed: int = 0,
    scale: float = 1.0,
) -> dict[str, Attempt]:
    """Each method on a pair of clouds; nothing where one of these is next to empty.

    Features are computed once, and counted for each method.

    Parameters
    ----------
    query, match : (N, 3) metres
    o3d : of `open3d`
    methods : of METHODS
    seed : of the random choices
    scale : that all lengths are multiplied by: 1 for rooms
    """
    register, search = o3d.pipelines.registration, _searching(o3d, scale)
    shared, clouds = Clock(), [cloud_of(points, o3d) for points in (query, match)]
    thin = shared.run("voxel grid", lambda: [c.voxel_down_sample(scale * VOXEL) for c in clouds])
    if min(len(c.points) for c in thin) < _FEWEST:
        return {}
    shared.run("normals", lambda: [c.estimate_normals(search(*NORMALS)) for c in thin])
    features = shared.run(
        "features", lambda: [register.compute_fpfh_feature(c, search(*FEATURES)) for c in thin]
    )
    found = {}
    for name in methods:
        clock, estimate = Clock(), _ransac if name == METHODS[0] else _fgr
        clock.stages |= shared.stages
        o3d.utility.random.seed(seed)
        start = clock.run(name.split()[-1], lambda: estimate(thin, features, o3d, scale))  # noqa: B023
        refined = clock.run("ICP", lambda: _icp(clouds, start, o3d, scale))  # noqa: B023
        found[name] = Attempt(start, refined, clock.stages)
    return found


def cloud_of(points: Floats, o3d: Any) -> Any:
    """Open3D's cloud of (N, 3) points."""
    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))


def _searching(o3d: Any, scale: float) -> Callable[[float, int], Any]:
    return lambda radius, most: o3d.geometry.KDTreeSearchParamHybrid(scale * radius, most)


def _ransac(thin: list[Any], features: list[Any], o3d: Any, scale: float) -> Floats:
    register = o3d.pipelines.registration
    found = register.registration_ransac_based_on_feature_matching(
        *thin,
        *features,
        True,
        scale * CORRESPONDENCE,
        register.TransformationEstimationPointToPoint(False),
        POINTS,
        [
            register.CorrespondenceCheckerBasedOnEdgeLength(EDGES),
            register.CorrespondenceCheckerBasedOnDistance(scale * CORRESPONDENCE),
        ],
        register.RANSACConvergenceCriteria(HYPOTHESES, CONFIDENCE),
    )
    return np.array(found.transformation, np.float64)


def _fgr(thin: list[Any], features: list[Any], o3d: Any, scale: float) -> Floats:
    register = o3d.pipelines.registration
    option = register.FastGlobalRegistrationOption(
        maximum_correspondence_distance=scale * FGR_CORRESPONDENCE
    )
    found = register.registration_fgr_based_on_feature_matching(*thin, *features, option)
    return np.array(found.transformation, np.float64)


def _icp(clouds: list[Any], start: Floats, o3d: Any, scale: float) -> Floats:
    """Point to plane; the finer clouds and the normals it asks for are its own."""
    register = o3d.pipelines.registration
    fine = [c.voxel_down_sample(scale * ICP_VOXEL) for c in clouds]
    fine[1].estimate_normals(_searching(o3d, scale)(*NORMALS))
    found = register.registration_icp(
        *fine,
        scale * ICP_CORRESPONDENCE,
        start,
        register.TransformationEstimationPointToPlane(),
    )
    return np.array(found.transformation, np.float64)
