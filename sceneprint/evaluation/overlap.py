"""How much two frames with known poses see of each other: the ground truth of retrieval.

Frame  --view_of-->  View        queries, database  --overlaps-->  Overlaps
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sceneprint.geometry.kernel import kernel
from sceneprint.geometry.rigid import moved
from sceneprint.types import Floats, Floats32, Frame, Intrinsics

#: Spacing of the samples that are looked up in the other frame, pixels.
GRID = 20
#: Two depths agree within this, metres, plus this share of the depth.
TOLERANCE, RELATIVE_TOLERANCE = 0.05, 0.03
#: Two depths of a pair agree within this, metres: the measure that sorts pairs into bins.
PAIR_TOLERANCE = 0.10


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
class Overlaps:
    """Overlap of queries with database frames, by its two definitions.

    Parameters
    ----------
    mean : (Q, N) of retrieval: mean over both directions of the share of samples that the other
        frame sees within 5 cm + 3 % of the depth
    least : (Q, N) of pairs: the smaller direction, agreement within 10 cm
    """

    mean: Floats
    least: Floats


def view_of(frame: Frame) -> View:
    """What overlap reads of a frame with a pose."""
    if frame.pose is None:
        raise ValueError(f"{frame.name} has no pose")
    k = frame.intrinsics
    y, x = np.mgrid[GRID // 2 : k.height : GRID, GRID // 2 : k.width : GRID]
    z = frame.depth[y, x].astype(float)
    points = np.stack([(x - k.cx) / k.fx * z, (y - k.cy) / k.fy * z, z], axis=-1)[z > 0]
    return View(np.ascontiguousarray(moved(frame.pose, points)), frame.depth, k, frame.pose)


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


def _shares(points: Floats, view: View) -> tuple[float, float]:
    if not len(points):
        return 0.0, 0.0
    k = view.intrinsics
    camera = np.array([k.fx, k.fy, k.cx, k.cy])
    loose, strict = _seen(points, view.depth, camera, view.pose)
    return loose / len(points), strict / len(points)


def overlap(a: View, b: View) -> tuple[float, float]:
    """Overlap of two frames of one parent frame: (mean, least) as in `Overlaps`."""
    there, back = _shares(a.samples, b), _shares(b.samples, a)
    return (there[0] + back[0]) / 2, min(there[1], back[1])


def overlaps(queries: Sequence[View], database: Sequence[View]) -> Overlaps:
    """Overlap of every query with every database frame of the same parent frame."""
    found = np.array([[overlap(q, d) for d in database] for q in queries], float)
    found = found.reshape(len(queries), len(database), 2)
    return Overlaps(found[..., 0], found[..., 1])
