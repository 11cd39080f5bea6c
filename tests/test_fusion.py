"""Tests of fused views of a room: position and area of the surface."""

import sys
from dataclasses import replace

import numpy as np
import pytest

from sceneprint.errors import InvalidRequest, MissingDependency, UselessFrame
from sceneprint.fusion import FusionParameters, fuse, open3d, prepare_view
from sceneprint.geometry.surface.coverage import (
    TriangleMesh,
    added_areas,
    first_views,
    observed_volume,
    share_seen,
)
from sceneprint.types import DepthFrame, Intrinsics

#: Half the room's width, height and depth, metres: x right, y down, z forward; its centre at 0.
ROOM = np.array([2.0, 1.25, 1.5])
CAMERA = Intrinsics(160, 120, 80.0, 80.0, 79.5, 59.5)  # sees 90 by 74 degrees


def view(yaw, at=(0, 0, 0), pitch=0.0):
    c, s = np.cos(np.radians(yaw)), np.sin(np.radians(yaw))
    e, f = np.cos(np.radians(pitch)), np.sin(np.radians(pitch))
    T = np.eye(4)
    T[:3, :3] = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ [[1, 0, 0], [0, e, -f], [0, f, e]]
    T[:3, 3] = at
    y, x = np.mgrid[0 : CAMERA.height, 0 : CAMERA.width]
    rays = np.stack([(x - CAMERA.cx) / CAMERA.fx, (y - CAMERA.cy) / CAMERA.fy, np.ones(x.shape)])
    rays = np.moveaxis(rays, 0, -1) @ T[:3, :3].T
    with np.errstate(divide="ignore"):
        depth = ((np.where(rays > 0, ROOM, -ROOM) - T[:3, 3]) / rays).min(axis=-1)
    return DepthFrame(depth.astype(np.float32), CAMERA, f"yaw {yaw:g}", T)


@pytest.fixture(scope="module")
def around(with_open3d):
    """All walls of the room, the floor and the ceiling, seen from six sides."""
    return [*(view(yaw) for yaw in (0, 90, 180, 270)), view(0, pitch=90), view(0, pitch=-90)]


def test_the_surface_lies_on_the_walls_and_has_their_area(around):
    """From the middle of the room in 26 directions: no part of a wall is unseen."""
    whole = [view(yaw, pitch=pitch) for pitch in (-50, 0, 50) for yaw in range(0, 360, 45)]
    mesh, voxel = fuse([*whole, *around[4:]], FusionParameters(voxel_m=0.026))
    walls = 8 * (ROOM[0] * ROOM[1] + ROOM[1] * ROOM[2] + ROOM[0] * ROOM[2])
    assert voxel == 0.026
    # edges of the room are rounded off by voxels; elsewhere a pixel, 2 cm wide, sets the limit
    off = np.sort(np.abs(np.abs(mesh.points) - ROOM), axis=1)
    assert off[:, 0].max() < voxel
    assert off[off[:, 1] > 3 * voxel, 0].max() < 0.02
    assert np.quantile(off[:, 0], 0.9) < 0.012
    assert mesh.areas().sum() == pytest.approx(walls, rel=0.01)
    # normals look into the room, and triangles turn the same way
    assert (np.einsum("ij,ij->i", mesh.normals, -mesh.points) > 0).all()
    a, b, c = (mesh.points[mesh.triangles[:, i]] for i in range(3))
    turning = np.einsum("ij,ij->i", np.cross(b - a, c - a), mesh.normals[mesh.triangles[:, 0]])
    assert (turning > -1e-6).mean() > 0.999


def test_a_finer_voxel_is_taken_as_wanted_until_blocks_run_out(around):
    p = FusionParameters(voxel_m=0.05)
    mesh, voxel = fuse(around[:1], p)
    assert voxel == 0.05
    assert len(mesh.points) > 0
    with pytest.raises(InvalidRequest, match=r"Voxels of 0\.05 m need \d+ blocks") as refused:
        fuse(around[:1], replace(p, most_blocks=40))
    # what is advised suffices; unasked, a voxel is chosen that does
    advised = float(str(refused.value).split("Request ")[1].split(" m")[0])
    fuse(around[:1], replace(p, voxel_m=advised, most_blocks=40))
    assert fuse(around[:1], FusionParameters(most_blocks=40))[1] > 0.05
    # two pixels of the wall ahead, 1.5 m away
    assert fuse(around[:1])[1] == pytest.approx(2 * 1.5 / 80, abs=0.001)


def test_out_of_range_is_not_fused(around):
    with pytest.raises(UselessFrame, match=r"between 0\.3 and 1 m"):
        fuse(around[:1], FusionParameters(farthest_m=1.0))
    holes = replace(around[0], depth=np.where(np.eye(120, 160) > 0, np.nan, around[0].depth))
    kept = prepare_view(holes, FusionParameters())
    assert (kept.depth[np.eye(120, 160) > 0] == 0).all()


def test_a_thinned_view_keeps_its_rays(around):
    thin = prepare_view(around[0], FusionParameters(most_samples=5000))
    assert thin.depth.shape == (60, 80)
    for x, y in ((0, 0), (17, 40), (79, 59)):
        assert thin.depth[y, x] == around[0].depth[2 * y, 2 * x]
        k, whole = thin.intrinsics, CAMERA
        assert (x - k.cx) / k.fx == pytest.approx((2 * x - whole.cx) / whole.fx, abs=1e-12)
        assert (y - k.cy) / k.fy == pytest.approx((2 * y - whole.cy) / whole.fy, abs=1e-12)


def test_first_seen_by_hand():
    """One square of two triangles, the first seen by the second view alone."""
    points = np.array([[0, 0, 1], [1, 0, 1], [0, 1, 1], [1, 1, 1.0]])
    mesh = TriangleMesh(
        points, np.tile([0, 0, -1.0], (4, 1)), np.array([[0, 2, 1], [1, 2, 3]], np.int32)
    )
    assert mesh.areas().tolist() == [0.5, 0.5]
    k = Intrinsics(3, 3, 1.0, 1.0, 1.0, 1.0)  # one pixel for each metre at a metre
    near, far = np.full((3, 3), 1.0, np.float32), np.full((3, 3), 1.0, np.float32)
    near[1, 1], near[1, 2], near[2, 1] = 0, 2.0, 2.0  # nothing known, and seen through
    far[2, 2] = 0
    views = [DepthFrame(near, k, "a", np.eye(4)), DepthFrame(far, k, "b", np.eye(4))]
    first = first_views(mesh, views, 0.1)
    assert first.tolist() == [1, 1, 1, 0]
    assert added_areas(mesh, first, 2).tolist() == [0.5, 0.5]
    assert share_seen(points, views[:1]) == 0.25
    assert share_seen(points, views) == 1.0
    for farther, share in ((0.0799, 0.75), (0.0830, 0.0)):  # 5 cm and 3 % of 1.08 m
        assert share_seen(points + np.array([0, 0, farther]), views[1:]) == share


def test_the_observed_volume_is_that_of_the_view_cone(around):
    # a pyramid to a wall 1.5 m ahead, 160/80 * 1.5 wide and 120/80 * 1.5 high
    ahead = replace(around[0], depth=np.full((120, 160), 1.5, np.float32))
    volume, cell = observed_volume([ahead])
    assert cell == 0.05
    assert volume == pytest.approx(3.0 * 2.25 * 1.5 / 3, rel=0.08)
    assert observed_volume([ahead, ahead])[0] == volume
    # all directions are seen, but for those between the cones at the corners of the room
    whole, _ = observed_volume([*around, *(view(yaw) for yaw in (45, 135, 225, 315))])
    assert whole == pytest.approx(8 * ROOM.prod(), rel=0.08)
    assert observed_volume([])[0] == 0.0


def test_without_open3d_the_message_names_the_packages(monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)  # as if a system library were missing
    with pytest.raises(MissingDependency, match="apt-get install libgl1 libegl1 libx11-6 libusb"):
        open3d("A reconstruction")
