"""How much two frames with known poses see of each other: the ground truth of retrieval.

Frame or Cloud  --view_of-->  AnyView        queries, database  --overlaps-->  Overlaps
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sceneprint.geometry.kernel import kernel
from sceneprint.geometry.rigid import moved
from sceneprint.types import AnyFrame, Cloud, Floats, Floats32, Intrinsics

if TYPE_CHECKING:
    from scipy.spatial import KDTree

#: Spacing of the samples that are looked up in the other frame, pixels.
GRID = 20
#: Two depths agree within this, metres, plus this share of the depth.
TOLERANCE, RELATIVE_TOLERANCE = 0.05, 0.03
#: Two depths of a pair agree within this, metres: the measure that sorts pairs into bins.
PAIR_TOLERANCE = 0.10
#: Points of a cloud that are looked up in the other frame, and that are looked among, at most.
SAMPLES, POINTS = 2_000, 100_000


@dataclass(frozen=True, eq=False)
class View:
    """What overlap reads of a frame.

    Parameters
    ----------
    samples : (N, 3) metres, valid depth samples of a grid, in the parent frame
    depth : (H, W) float32, metres; 0 where missing
    intrinsics : of the depth image
    pose : (4, 4) T_parent_sensor
    """

    samples: Floats
    depth: Floats32
    intrinsics: Intrinsics
    pose: Floats


@dataclass(frozen=True, eq=False)
class CloudView:
    """What overlap reads of a cloud.

    Parameters
    ----------
    samples : (N, 3) metres, points of the cloud, in the parent frame
    points : (M, 3) of the parent frame, to find the nearest
    viewpoint : (3,) in the parent frame; None where there is none
    """

    samples: Floats
    points: KDTree
    viewpoint: Floats | None


AnyView = View | CloudView


@dataclass(frozen=True, eq=False)
class Overlaps:
    """Overlap of queries with database frames, by its two definitions.

    Parameters
    ----------
    mean : (Q, N) of retrieval: mean over both directions of the share of samples that the other
        frame sees within 5 cm + 3 % of the depth
    least : (Q, N) of pairs: the smaller direction, agreement within 10 cm

    A cloud sees a sample that has one of its points as near. As its points thin out with range,
    10 cm + 3 % of the range from its viewpoint count there.
    """

    mean: Floats
    least: Floats


def view_of(frame: AnyFrame) -> AnyView:
    """What overlap reads of a frame with a pose."""
    if frame.pose is None:
        raise ValueError(f"{frame.name} has no pose")
    if isinstance(frame, Cloud):
        return _cloud_view(frame, frame.pose)
    k = frame.intrinsics
    y, x = np.mgrid[GRID // 2 : k.height : GRID, GRID // 2 : k.width : GRID]
    z = frame.depth[y, x].astype(float)
    points = np.stack([(x - k.cx) / k.fx * z, (y - k.cy) / k.fy * z, z], axis=-1)[z > 0]
    return View(np.ascontiguousarray(moved(frame.pose, points)), frame.depth, k, frame.pose)


def _cloud_view(cloud: Cloud, pose: Floats) -> CloudView:
    from scipy.spatial import KDTree

    every = moved(pose, cloud.points.astype(np.float64))
    some, most = (every[:: -(-len(every) // n)] for n in (SAMPLES, POINTS))
    return CloudView(some, KDTree(most), pose[:3, 3] if cloud.has_viewpoint else None)


@kernel
def _seen(points: Floats, depth: Floats32, k: Floats, pose: Floats) -> tuple[int, int]:
    """Of points in the parent frame, those that a frame sees where they are: both tolerances."""
    height, width = depth.shape
    loose = strict = 0
    for i in range(len(points)):
        dx, dy, dz = points[i, 0] - pose[0, 3], points[i, 1] - pose[1, 3], points[i, 2] - pose[2, 3]
        z = dx * pose[0, 2] + dy * pose[1, 2] + dz * pose[2, 2]
        if not z > 1e-6:
            continue
        x = np.rint((dx * pose[0, 0] + dy * pose[1, 0] + dz * pose[2, 0]) / z * k[0] + k[2])
        y = np.rint((dx * pose[0, 1] + dy * pose[1, 1] + dz * pose[2, 1]) / z * k[1] + k[3])
        if x >= 0 and x < width and y >= 0 and y < height:
            there = depth[int(y), int(x)]
            if there > 0:
                off = abs(there - z)
                loose += off < TOLERANCE + RELATIVE_TOLERANCE * z
                strict += off < PAIR_TOLERANCE
    return loose, strict


def _near(points: Floats, cloud: CloudView) -> tuple[int, int]:
    """Of points in the parent frame, those that a cloud has a point at: both tolerances."""
    wide = np.zeros(len(points))
    if cloud.viewpoint is not None:
        wide = RELATIVE_TOLERANCE * np.linalg.norm(points - cloud.viewpoint, axis=1)
    off, _ = cloud.points.query(points, distance_upper_bound=float(wide.max()) + PAIR_TOLERANCE)
    return int((off < TOLERANCE + wide).sum()), int((off < PAIR_TOLERANCE + wide).sum())


def _shares(points: Floats, view: AnyView) -> tuple[float, float]:
    if not len(points):
        return 0.0, 0.0
    if isinstance(view, CloudView):
        loose, strict = _near(points, view)
        return loose / len(points), strict / len(points)
    k = view.intrinsics
    camera = np.array([k.fx, k.fy, k.cx, k.cy])
    loose, strict = _seen(points, view.depth, camera, view.pose)
    return loose / len(points), strict / len(points)


def overlap(a: AnyView, b: AnyView) -> tuple[float, float]:
    """Overlap of two frames of one parent frame: (mean, least) as in `Overlaps`."""
    there, back = _shares(a.samples, b), _shares(b.samples, a)
    return (there[0] + back[0]) / 2, min(there[1], back[1])


def overlaps(queries: Sequence[AnyView], database: Sequence[AnyView]) -> Overlaps:
    """Overlap of every query with every database frame of the same parent frame."""
    found = np.array([[overlap(q, d) for d in database] for q in queries], float)
    found = found.reshape(len(queries), len(database), 2)
    return Overlaps(found[..., 0], found[..., 1])
