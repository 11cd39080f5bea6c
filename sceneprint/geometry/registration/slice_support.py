"""Support for a transform between two scans by their points above the ground (Sec. III-E).

    ScanPlan, ScanPlan, T, slice hypotheses  --refine_by_slices-->  T_target_source, distinctness
    ScanPlan, ScanPlan, T  --measure_distinctness-->  distinctness

In streets, distant scans share few planes, and the shared part of the ground is rarely plane, so
that planes neither confirm a transform nor determine its tilt. But a transform is unlikely to be
wrong if the points above the ground correlate much better under it than under all others, and these
points also determine all six degrees of freedom. This method is not part of the paper.
"""

from __future__ import annotations

import numpy as np

from sceneprint.geometry.kernel import kernel
from sceneprint.geometry.registration.plan_search import (
    PlanParameters,
    ScanPlan,
    slice_correlation,
    slice_hypotheses,
)
from sceneprint.geometry.rigid import are_near, nearest_rotation
from sceneprint.types import Floats, Floats32, Ints32

#: Maximum difference between a transform and the slice hypothesis that led to it: cells of slices,
#: and steps of yaw.
_SAME_CELLS, _SAME_YAWS = 4.0, 1.6
#: Distance between scanners below which points correlate at any place, cells of slices.
_CLOSE_CELLS = 5.0
#: Number of iterations; corresponding points are at most one cell apart.
_ITERATIONS = 16
#: Minimum sum of the weights of corresponding points.
_LEAST_WEIGHT = 20.0


def refine_by_slices(
    source: ScanPlan, target: ScanPlan, T: Floats, hypotheses: Floats, values: Floats,
    p: PlanParameters,
) -> tuple[Floats, float]:  # fmt: skip
    """Refine a transform by the points in slices, and measure how distinct it is from all others.

    A transform that correlates much less than others is not refined. Neither is one between
    scanners that are close to each other: similar places may then correlate as well as the same
    place, and close scans have other evidence in common.

    Parameters
    ----------
    source, target : plans of two scans
    T : (4, 4) T_target_source
    hypotheses, values : (n, 4, 4) and (n,) results of `slice_hypotheses`

    Returns
    -------
    T_target_source : (4, 4) refined or unchanged transform
    distinctness : ratio of its slice correlation to the highest elsewhere; 0 if not refined
    """
    if np.linalg.norm(T[:3, 3]) < p.slice_distance * p.cell:
        return T, 0.0
    near, elsewhere = split_correlations(T, hypotheses, values, target.R[2], p)
    if near <= p.slice_share * elsewhere:
        return T, 0.0
    refined = refine_by_points(source, target, T, p)
    if refined is None:
        return T, 0.0
    return refined, _compare(source, target, refined, hypotheses, values, p)


def measure_distinctness(source: ScanPlan, target: ScanPlan, T: Floats, p: PlanParameters) -> float:
    """Return the ratio of the slice correlation under T_target_source to the highest elsewhere.

    The result is 0 if the transform correlates much less than others, or if the scanners are close
    to each other; see `refine_by_slices`.
    """
    if np.linalg.norm(T[:3, 3]) < p.slice_distance * p.cell:
        return 0.0
    distinctness = _compare(source, target, T, *slice_hypotheses(source, target, p), p)
    return distinctness if distinctness > p.slice_share else 0.0


def _compare(
    source: ScanPlan, target: ScanPlan, T: Floats, hypotheses: Floats, values: Floats,
    p: PlanParameters,
) -> float:  # fmt: skip
    """Return the ratio of the slice correlation under T to the highest elsewhere."""
    near, elsewhere = split_correlations(T, hypotheses, values, target.R[2], p)
    return max(near, slice_correlation(source, target, T, p)) / max(elsewhere, 1e-9)


def split_correlations(
    T: Floats, hypotheses: Floats, values: Floats, up: Floats, p: PlanParameters
) -> tuple[float, float]:
    """Return the highest slice correlation near a transform, and the highest elsewhere.

    Hypotheses for scanners that are close to each other are skipped: because most points are near
    the scanners, they correlate at any place.

    Parameters
    ----------
    T : (4, 4) T_target_source
    hypotheses, values : (n, 4, 4) and (n,) results of `slice_hypotheses`
    up : (3,) unit vector in the target's coordinates; heights are not compared

    Returns
    -------
    near : correlation; 0 if no hypothesis is near T
    elsewhere : correlation; at least the lowest value, because hypotheses with lower values are not
        listed
    """
    level = np.concatenate([T[None], hypotheses])
    level[:, :3, 3] -= (level[:, :3, 3] @ up)[:, None] * up
    metres, radians = 2 * p.cell * _SAME_CELLS, _SAME_YAWS * 2 * np.pi / p.n_yaws
    near = are_near(level[1:], level[0], metres, radians)
    apart = np.linalg.norm(level[1:, :3, 3], axis=1) >= 2 * p.cell * _CLOSE_CELLS
    elsewhere = values[~near & apart].max(initial=values.min())
    return float(values[near & apart].max(initial=0.0)), float(elsewhere)


def refine_by_points(
    source: ScanPlan, target: ScanPlan, T: Floats, p: PlanParameters
) -> Floats | None:
    """Refine a transform by point-to-point ICP in both directions, with the points of all slices.

    Parameters
    ----------
    source, target : plans of two scans
    T : (4, 4) T_target_source

    Returns
    -------
    (4, 4) refined T_target_source; None if too few points correspond
    """
    a, b = (plan.points[plan.slices > 0] for plan in (source, target))
    cell = 2 * p.cell
    binned = [_bin_points(points, cell, p.side) for points in (a, b)]
    R = target.R @ T[:3, :3] @ source.R.T
    t = target.R @ T[:3, 3]
    for _ in range(_ITERATIONS):
        sums = np.zeros(16)
        _add_pairs(a, R, t, b, *binned[1], cell, p.side, True, sums)
        _add_pairs(b, R.T.copy(), -R.T @ t, a, *binned[0], cell, p.side, False, sums)
        if sums[0] < _LEAST_WEIGHT:
            return None
        mean_a, mean_b = sums[1:4] / sums[0], sums[4:7] / sums[0]
        R = nearest_rotation(sums[7:].reshape(3, 3) - sums[0] * np.outer(mean_b, mean_a))
        t = mean_b - R @ mean_a
    result = np.eye(4)
    result[:3, :3] = target.R.T @ R @ source.R
    result[:3, 3] = target.R.T @ t
    return result


def _bin_points(points: Floats32, cell: float, side: int) -> tuple[Ints32, Ints32]:
    """Return the first place of each cell in the order of the points, and that order.

    Points beyond the image are in no cell.

    Returns
    -------
    starts : (side^2 + 1,) places; the points of cell k are at starts[k] to starts[k + 1]
    order : (n,) indices of points, sorted by cell
    """
    at = np.floor(points[:, :2] / cell).astype(np.int64) + side // 2
    inside = np.flatnonzero(((at >= 0) & (at < side)).all(axis=1))
    cells = at[inside, 1] * side + at[inside, 0]
    order = inside[np.argsort(cells, kind="stable")]
    starts = np.zeros(side * side + 1, np.int32)
    np.cumsum(np.bincount(cells, minlength=side * side), out=starts[1:])
    return starts, order.astype(np.int32)


@kernel
def _add_pairs(
    source: Floats32, R: Floats, t: Floats, target: Floats32, starts: Ints32, order: Ints32,
    cell: float, side: int, forward: bool, sums: Floats,
) -> None:  # fmt: skip
    """Add each moved point and its nearest target point, if within a cell's width, to sums.

    The sums are of w, w a, w b and w b a^T, with a = source and b = target if `forward`, otherwise
    the reverse. The weight w falls from 1 at distance 0 to 0 at a cell's width.
    """
    moved, nearest = np.empty(3), np.empty(3)
    for i in range(len(source)):
        for k in range(3):
            moved[k] = t[k]
            for m in range(3):
                moved[k] += R[k, m] * source[i, m]
        u, v = (
            int(np.floor(moved[0] / cell)) + side // 2,
            int(np.floor(moved[1] / cell)) + side // 2,
        )
        least, best = cell * cell, -1
        for line in range(max(v - 1, 0), min(v + 2, side)):
            first = line * side + min(max(u - 1, 0), side)
            last = line * side + min(max(u + 2, 0), side)
            for place in range(starts[first], starts[last]):
                j = order[place]
                square = 0.0
                for k in range(3):
                    square += (moved[k] - target[j, k]) ** 2
                if square < least:
                    least, best = square, j
        if best < 0:
            continue
        w = (1.0 - least / (cell * cell)) ** 2
        sums[0] += w
        for k in range(3):
            a, b = (source[i, k], target[best, k]) if forward else (target[best, k], source[i, k])
            sums[1 + k] += w * a
            sums[4 + k] += w * b
            nearest[k] = b
        for k in range(3):
            for m in range(3):
                a = source[i, m] if forward else target[best, m]
                sums[7 + 3 * k + m] += w * nearest[k] * a
