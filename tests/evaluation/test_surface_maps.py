"""Tests of maps that are fused to a surface and rendered as views."""

import numpy as np

from sceneprint.types import Cloud
from sceneprint_lab.evaluation.surface_maps import join_frames

UP = np.array([0.0, 0.0, 1.0])


def test_clouds_are_joined_to_a_point_a_voxel():
    """In the parent frame: the mean of what lies in each voxel."""
    quarter = np.array([[0.0, -1, 0, 1], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    first = Cloud(np.array([[0.2, 0.2, 0.2], [3.0, 0.5, 0.5]], np.float32), pose=np.eye(4))
    # a quarter turn, then 1 m along x: (0.4, 0.6, 0.4) becomes (0.4, 0.4, 0.4)
    other = Cloud(np.array([[0.4, 0.6, 0.4]], np.float32), pose=quarter)
    joined = join_frames([first, other], 1.0, UP)
    assert joined.triangles is None
    np.testing.assert_allclose(joined.points, [[0.3, 0.3, 0.3], [3.0, 0.5, 0.5]], atol=1e-6)
    np.testing.assert_array_equal(joined.up, UP)
