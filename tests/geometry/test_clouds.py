"""Tests of the selection of points of a cloud, and of rotated axes."""

import numpy as np
import pytest

from sceneprint.errors import UselessFrame
from sceneprint.geometry.surface.cloud import CloudParameters, principal_axes, select_in_range
from sceneprint.types import Cloud
from tests.geometry import cloud_scenes

P = CloudParameters(minimum_points=3)


def test_points_out_of_range_are_left_out():
    ranges = np.array([0.29, 0.31, 1.0, 9.99, 10.01, 500.0])
    points = (ranges[:, None] * np.array([0.6, 0.0, -0.8])).astype(np.float32)
    np.testing.assert_array_equal(select_in_range(Cloud(points), P), points[1:4])
    # nothing is known of ranges where there is no viewpoint
    np.testing.assert_array_equal(select_in_range(Cloud(points, has_viewpoint=False), P), points)


@pytest.mark.parametrize(
    ("factor", "says"),
    [(1000.0, "if the coordinates are millimetres, set 1000 units per metre"), (0.01, "units")],
)
def test_out_of_range_names_the_range_and_what_to_do(factor, says):
    cloud = cloud_scenes.room(500)
    with pytest.raises(UselessFrame, match=r"0 of its 500 .* 0\.3 to 10 m.* median") as caught:
        select_in_range(Cloud(cloud.points * np.float32(factor), name="scan"), P)
    assert says in str(caught.value)
    assert "lidar" in str(caught.value)
    assert str(caught.value).startswith("scan: ")


def test_too_few_points_are_none_of_the_range():
    with pytest.raises(UselessFrame, match=r"10 points are too few .* at least 64"):
        select_in_range(Cloud(np.ones((10, 3), np.float32)), CloudParameters())


def test_axes_are_eigenvectors_signed_by_skew():
    points = cloud_scenes.room(5000).points
    axes = principal_axes(points)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1.0)
    moments = axes @ (points.astype(float).T @ points) @ axes.T
    off = moments - np.diag(np.diag(moments))
    assert np.abs(off).max() < 1e-3 * moments.max()
    assert (np.diff(np.diag(moments)) < 0).all()
    assert ((points @ axes[:2].T) ** 3).sum(axis=0).min() > 0


def test_defaults_never_change():
    """Shipped models without these numbers in their files were made with them."""
    assert CloudParameters() == CloudParameters(
        0.3, 10.0, 64, 1 / 146, 0.02, 5.2, 8.2, 1200, 600, 76800, 0.03, 3, 0.05, 0.006, 0.006,
        9, 0.3, 0.12, 1 / 146, 3, 6, 0.95,
    )  # fmt: skip
