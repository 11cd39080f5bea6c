"""Tests of the overlap of clouds, for walls of points."""

import numpy as np
import pytest

from sceneprint.types import Cloud
from sceneprint_lab.evaluation.protocol import overlap, view_of


def wall(left, right, ahead=2.0, *, at=0.0, has_viewpoint=True):
    """A wall of points 1 cm apart across x, 5 cm up, seen from `at` on the x axis."""
    x, y = np.meshgrid(np.arange(left, right - 1e-9, 0.01), np.arange(-0.5, 0.5, 0.05))
    points = np.column_stack([x.ravel() - at, y.ravel(), np.full(x.size, ahead)])
    pose = np.eye(4)
    pose[0, 3] = at
    return Cloud(points.astype(np.float32), has_viewpoint, pose=pose)


def test_half_of_a_wall():
    mean, least = overlap(view_of(wall(0, 1)), view_of(wall(0.5, 1.5, at=0.3)))
    # half, and what lies within 5 cm + 3 % (or 10 cm + 3 %) of 2 m beyond the edge
    assert mean == pytest.approx(0.5 + 0.11, abs=0.02)
    assert least == pytest.approx(0.5 + 0.16, abs=0.02)


def test_the_two_tolerances_grow_with_range():
    near, far = wall(0, 1), wall(0, 1, 20.0)
    assert overlap(view_of(near), view_of(wall(0, 1, 2.13))) == (0.0, 1.0)  # 11 to 16 cm
    assert overlap(view_of(near), view_of(wall(0, 1, 2.3))) == (0.0, 0.0)
    assert overlap(view_of(far), view_of(wall(0, 1, 20.6))) == (1.0, 1.0)  # 65 cm at 20 m


def test_without_a_viewpoint_they_do_not():
    far = view_of(wall(0, 1, 20.0, has_viewpoint=False))
    assert overlap(far, view_of(wall(0, 1, 20.2, has_viewpoint=False))) == (0.0, 0.0)
    assert overlap(far, view_of(wall(0, 1, 20.08, has_viewpoint=False))) == (0.0, 1.0)
