"""How much two frames with known poses see of each other: the ground truth of retrieval."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sceneprint.types import Floats, Frame, Intrinsics

#: Spacing of the samples that are looked up in the other frame, pixels.
GRID = 20
#: Two depths agree within this, metres, plus this share of the depth.
TOLERANCE, RELATIVE_TOLERANCE = 0.05, 0.03


def samples(frame: Frame) -> Floats:
    """Points of a grid of valid samples, in the parent frame: (N, 3) metres."""
    k = frame.intrinsics
    y, x = np.mgrid[GRID // 2 : k.height : GRID, GRID // 2 : k.width : GRID]
    z = frame.depth[y, x].astype(float)
    points = np.stack([(x - k.cx) / k.fx * z, (y - k.cy) / k.fy * z, z], axis=-1)[z > 0]
    assert frame.pose is not None
    moved: Floats = points @ frame.pose[:3, :3].T + frame.pose[:3, 3]
    return moved


def seen_share(points: Floats, depth: NDArray[np.float32], k: Intrinsics, pose: Floats) -> float:
    """Share of points that another frame sees at the depth where they are."""
    if not len(points):
        return 0.0
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    ahead = local[local[:, 2] > 1e-6]
    x = np.rint(ahead[:, 0] / ahead[:, 2] * k.fx + k.cx).astype(int)
    y = np.rint(ahead[:, 1] / ahead[:, 2] * k.fy + k.cy).astype(int)
    inside = (x >= 0) & (x < k.width) & (y >= 0) & (y < k.height)
    z, there = ahead[inside, 2], depth[y[inside], x[inside]]
    agree = (there > 0) & (np.abs(there - z) < TOLERANCE + RELATIVE_TOLERANCE * z)
    return float(agree.sum() / len(points))


def overlaps(queries: list[Frame], database: list[Frame]) -> Floats:
    """Mean over both directions of the share of samples seen: (queries, database)."""
    of_queries, of_database = [samples(q) for q in queries], [samples(d) for d in database]
    result = np.zeros((len(queries), len(database)))
    for i, q in enumerate(queries):
        for j, d in enumerate(database):
            assert q.pose is not None
            assert d.pose is not None
            there = seen_share(of_queries[i], d.depth, d.intrinsics, d.pose)
            back = seen_share(of_database[j], q.depth, q.intrinsics, q.pose)
            result[i, j] = (there + back) / 2
    return result
