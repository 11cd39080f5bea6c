"""Tests of traces: residuals of points, coinciding patches and overlays."""

import numpy as np
import pytest

from sceneprint.geometry.registration.overlap import (
    OverlapParameters,
    overlap_counts,
    sample_points,
)
from sceneprint.geometry.rigid import inverse
from sceneprint.geometry.validation.inspection import (
    AGREES,
    OUTSIDE,
    SOURCE,
    STEP_COLOURS,
    TARGET,
    VIOLATES,
    VIOLATION,
    overlay,
    point_verdicts,
    residuals,
    trace,
)
from sceneprint.types import Geometry
from tests.geometry import scenes
from tests.geometry.scenes import patches_of

P = OverlapParameters(stride=3)


def shifted(x=0.0, z=0.0):
    T = np.eye(4)
    T[0, 3], T[2, 3] = x, z
    return T


def wall(z):
    ahead = np.array([0.0, 0.0, -1.0])
    q = scenes.plane(scenes.CAMERA, ahead, np.array([0.0, 0.0, z]))
    return scenes.lifted(scenes.CAMERA, q, np.broadcast_to(ahead, (*q.shape, 3)))


def patches(*rows):
    """One for each x, y, z and, if its normal is not -z, the normal."""
    return patches_of([row[:3] for row in rows], [row[3:] or (0, 0, -1) for row in rows])


def framed(surface, of):
    return Geometry(surface, of, np.zeros((len(of), 4), np.uint8), "a" * 64)


@pytest.mark.parametrize("T", [shifted(), shifted(0.04, 0.03), shifted(0.3, -0.3), shifted(z=9.0)])
def test_every_point_is_judged_as_it_is_counted(T):
    seen, _ = scenes.corner()
    points = sample_points(seen, P.stride)
    counts, verdicts = overlap_counts(points, seen, T, P), point_verdicts(points, seen, T, P)
    assert (verdicts == AGREES).sum() == counts.inliers
    assert (verdicts == VIOLATES).sum() == counts.violations
    for i in range(0, len(points), 41):
        alone = overlap_counts(points[i : i + 1], seen, T, P)
        assert verdicts[i] == (AGREES if alone.inliers else VIOLATES if alone.violations else 0)


@pytest.mark.parametrize("tolerance", [0.05, 0.12])
def test_residuals_by_hand(tolerance):
    seen, p = wall(2.0), OverlapParameters(stride=3, surface_tolerance=tolerance)
    points = sample_points(seen, 3)
    ahead = int(np.hypot(points[:, 0], points[:, 1]).argmin())
    # half a step off a whole one, as a share of the tolerance, and where nothing agrees
    for share, step in ((0.0, 1), (0.5, 1), (1.5, 2), (49.5, 50), (-50.5, 51), (249.5, 250)):
        T = shifted(z=share / 250 * tolerance)
        assert residuals(points, seen, T, p)[ahead] == step, share
    for z, byte in ((1.01 * tolerance, OUTSIDE), (0.4, OUTSIDE), (-0.2, VIOLATION)):
        assert residuals(points, seen, shifted(z=z), p)[ahead] == byte, z


def test_patches_coincide_with_each_others_nearest():
    T = shifted(1.0)
    query = patches(
        (0, 0, 2), (1, 0, 2), (1.05, 0, 2), (2, 0, 2), (3, 0, 2), (4, 0, 2, 0.6, 0.0, -0.8)
    )
    match = patches(
        (5.1, 0, 2), (4.2, 0, 2), (3, 0, 2, 1.0, 0.0, 0.0), (2.04, 0, 2), (1.03, 0.04, 2)
    )
    surface = wall(2.0)
    result = trace(framed(surface, query), framed(surface, match), T, P)
    # (1.05: at 2.05, nearer than 1's 2.0) (2: its normal differs) (3: 0.2 m off)
    # (4: at 5.0 with cos 0.8)
    assert result.pairs.tolist() == [[2, 3], [0, 4]]
    assert result.distances == pytest.approx([0.01, 0.05])
    assert (result.of_query == point_verdicts(result.query, surface, T, P)).all()
    assert (result.of_match == point_verdicts(result.match, surface, inverse(T), P)).all()
    nothing = trace(framed(surface, patches((0, 0, 9))), framed(surface, match), T, P)
    assert (nothing.pairs.shape, nothing.distances.shape) == ((0, 2), (0,))


def test_overlays_are_coloured():
    near, far = wall(1.5), wall(2.0)
    n = int(near.valid.sum())
    points, normals, colours = overlay(near, far, shifted(z=0.5))
    assert points[:n, 2] == pytest.approx(2.0)
    assert points[n:, 2] == pytest.approx(2.0)
    assert (normals == (0, 0, -1)).all()
    assert (colours[:n] == SOURCE).all()
    assert (colours[n:] == TARGET).all()
    turned = np.diag([1.0, -1.0, -1.0, 1.0])
    _, _, colours = overlay(near, far, turned, "normal")
    assert (colours[:n] == (128, 128, 255)).all()
    assert (colours[n:] == (128, 128, 0)).all()
    _, _, colours = overlay(near, far, shifted(), "residual")
    assert (colours[:n] == STEP_COLOURS[-1]).all()  # before what the other saw
    assert (colours[n:] == STEP_COLOURS[-2]).all()  # behind it
