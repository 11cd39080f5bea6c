"""Tests of a bag of redkitchen in every container against the folder."""

import numpy as np
import pytest

from sceneprint.formats.dataset import decode_png, find_sequences
from sceneprint.formats.recording.selection import RecordingOptions
from sceneprint.types import Cloud

STEP, COUNT = 10, 12
KINDS = ("16UC1", "compressedDepth", "points")


@pytest.fixture(scope="module")
def kitchen(data_root):
    (sequence,) = find_sequences(data_root / "7scenes/redkitchen/seq-01")
    return sequence.frames[::STEP][:COUNT]


def points_of(frame):
    """Points of every third pixel, organised, NaN where depth is missing."""
    k = frame.intrinsics
    v, u = np.mgrid[0 : k.height : 3, 0 : k.width : 3]
    z = frame.depth[v, u]
    z = np.where(z > 0, z, np.nan).astype(np.float32)
    points = np.zeros(z.shape, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4")])
    points["x"], points["y"], points["z"] = (u - k.cx) / k.fx * z, (v - k.cy) / k.fy * z, z
    return points


@pytest.mark.parametrize("container", ["mcap", "sqlite3", "ros1"])
@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_of_a_kitchen(kind, container, kitchen, tmp_path, ros):
    poses = [one.pose for one in kitchen]
    assert all(pose is not None for pose in poses)

    def fill(writer):
        writer.transforms(0.0, {("base_link", "camera"): ros.camera}, "/tf_static")
        for i, one in enumerate(kitchen):
            k, t = one.camera.intrinsics, i / 30 * STEP
            writer.camera_info(t, k=(k.fx, k.fy, k.cx, k.cy), size=(k.width, k.height))
            writer.transforms(t, {("odom", "base_link"): poses[i] @ np.linalg.inv(ros.camera)})
            if kind == "points":
                points = points_of(one.read_depth())
                writer.points(t, points.reshape(-1), frame="camera", height=len(points))
            else:
                samples = decode_png(one.read_bytes())
                (writer.image if kind == "16UC1" else writer.compressed)(t, samples)

    path = ros.write(tmp_path, fill, container, "kitchen")
    (sequence,) = find_sequences(path, RecordingOptions(keyframe_m=0))
    assert len(sequence.frames) == COUNT
    for one, found in zip(kitchen, sequence.frames, strict=True):
        expected, frame = one.read_depth(), found.read()
        check_pose(expected.pose, frame.pose)
        if isinstance(frame, Cloud):
            points = points_of(expected)
            xyz = np.stack([points[name] for name in "xyz"], axis=-1).reshape(-1, 3)
            np.testing.assert_array_equal(frame.points, xyz[np.isfinite(xyz).all(axis=1)])
        else:
            np.testing.assert_array_equal(frame.depth, expected.depth)
            assert frame.intrinsics == expected.intrinsics


def check_pose(expected, found):
    """Equal to 1 mm and 0.01 degrees."""
    assert np.linalg.norm(expected[:3, 3] - found[:3, 3]) < 1e-3
    turn = expected[:3, :3].T @ found[:3, :3]
    assert np.degrees(np.linalg.norm(turn - turn.T) / np.sqrt(8)) < 0.01
