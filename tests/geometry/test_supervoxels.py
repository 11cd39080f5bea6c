"""Tests of voxels and supervoxels of a room: normals, connections, gaps, order and rotation."""

import math
from dataclasses import replace

import numpy as np
import pytest

from sceneprint.geometry.signature.segmentation import SegmentationParameters, supervoxels
from sceneprint.geometry.surface.cloud import CloudParameters
from sceneprint.geometry.surface.voxels import voxels
from sceneprint.types import Cloud
from tests.geometry import cloud_scenes

P = CloudParameters(voxel_angle=0.03, voxel_size=0.06)
S = SegmentationParameters()


@pytest.mark.parametrize("has_viewpoint", [True, False])
def test_voxels_lie_on_the_walls(has_viewpoint):
    cloud = replace(cloud_scenes.room(60_000), has_viewpoint=has_viewpoint)
    seen = voxels(cloud, P)
    points, normals = seen.points[0].astype(float), seen.normals[0]
    inner = np.abs(normals).max(axis=1) > 0.9999
    assert inner.mean() > 0.75
    off = cloud_scenes.off_walls(points[inner])
    assert np.quantile(off, 0.95) < 1e-4
    assert ((points * normals).sum(axis=1) < 0).mean() > 0.999  # the centroid is near the origin
    size = cloud_scenes.HIGH - cloud_scenes.LOW
    whole = 2 * (size[0] * size[1] + size[1] * size[2] + size[2] * size[0])
    assert seen.areas.sum() == pytest.approx(whole, rel=0.2)


def test_no_patch_crosses_a_gap():
    grid = np.arange(-0.6, 0.6, 0.01)
    y, z = (one.reshape(-1) for one in np.meshgrid(grid, grid))
    # a board before a wall, 18 cm apart at 1.4 m
    x = np.where((np.abs(y) < 0.25) & (np.abs(z) < 0.25), 1.2, 1.4)
    scale = x / 1.4
    seen = voxels(Cloud(np.column_stack([x, y * scale, z * scale]).astype(np.float32)), P)
    labels = supervoxels(seen, 5.0, 1000, S)[0]
    depth = seen.points[0, :, 0]
    for k in range(labels.max() + 1):
        assert np.ptp(depth[labels == k]) < 0.1


def test_any_order_gives_the_same_bytes():
    cloud = cloud_scenes.room(20_000)
    for has_viewpoint in (True, False):
        a = voxels(replace(cloud, has_viewpoint=has_viewpoint), P)
        b = voxels(replace(cloud_scenes.shuffled(cloud), has_viewpoint=has_viewpoint), P)
        assert a.points.tobytes() == b.points.tobytes()
        assert a.normals.tobytes() == b.normals.tobytes()
        assert supervoxels(a, 5.0, 1000, S).tobytes() == supervoxels(b, 5.0, 1000, S).tobytes()


def test_no_more_than_are_wanted():
    cloud = cloud_scenes.room(30_000)
    few = replace(P, maximum_pixels=3000)
    for has_viewpoint in (True, False):
        seen = voxels(replace(cloud, has_viewpoint=has_viewpoint), few)
        assert 1000 < len(seen.sides) <= 3000
        assert seen.sides.min() > 0.03
        assert 5 < supervoxels(seen, 2.0, 20, S).max() + 1 <= 20


def test_parts_that_never_become_few_enough_come_to_an_end():
    """Plates apart from each other, more than may be patches, and no size too small for one."""
    side = np.linspace(0, 0.4, 14)
    plate = np.stack(np.meshgrid(side, side, [0.0]), axis=-1).reshape(-1, 3)
    corners = np.stack(np.meshgrid(np.arange(4), np.arange(3), [0]), axis=-1).reshape(-1, 3)
    points = (plate[None] + corners[:, None]).reshape(-1, 3).astype(np.float32)
    seen = voxels(Cloud(points, has_viewpoint=False), P)
    for least in (0.0, -1.0, math.nan):
        assert supervoxels(seen, 5.0, 8, replace(S, minimum_size=least)).max() < 8
