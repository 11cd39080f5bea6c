"""Tests of maps that are fused to a surface and rendered as views."""

from dataclasses import replace

import numpy as np
import pytest

from sceneprint.geometry.views import view_parameters
from sceneprint.models import read_model
from sceneprint.types import Cloud, DepthFrame
from sceneprint_lab.evaluation.surface_maps import join_frames, render_views
from sceneprint_lab.synth import synthesise_room
from sceneprint_lab.synth.dataset import room_and_rng

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


def test_depth_images_are_joined_to_a_mesh_that_views_are_rendered_of():
    room = synthesise_room(3, 0, 12)
    joined = join_frames(room.frames, 0.05, UP)
    assert joined.triangles is not None
    corners = room_and_rng(3, 0)[0].mesh.vertices
    low, high = corners.min(axis=0), corners.max(axis=0)
    assert (joined.points > low - 0.15).all()
    assert (joined.points < high + 0.15).all()
    p = replace(view_parameters(read_model("depth").parameters, heights=[1.2]), most_views=3)
    plan, views = render_views(joined, p)
    assert len(views) == len(plan.poses) == 3
    for view, pose in zip(views, plan.poses, strict=True):
        assert isinstance(view, DepthFrame)
        assert view.pose is not None
        np.testing.assert_array_equal(view.pose, pose)
        assert pose[2, 3] == pytest.approx(1.2, abs=0.2)
        # what it sees lies on the mesh: no farther than the room is wide
        assert 0 < view.depth[view.depth > 0].min() < view.depth.max() < np.linalg.norm(high - low)
