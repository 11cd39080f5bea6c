"""Tests of poses: values, round trips, and invalid files."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneprint.errors import InvalidPose
from sceneprint.formats.dataset import (
    SensorTrajectory,
    interpolate,
    read_pose,
    read_trajectory,
    rigid_transform,
    write_pose,
)

HALF = math.sqrt(0.5)


def pose_of(rotation, position):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.as_matrix(), position
    return pose


POSE = pose_of(Rotation.from_rotvec([0.3, -1.1, 0.7]), (1 / 3, -2e5, 1e-9))


def test_written_is_read(tmp_path):
    write_pose(tmp_path / "a.txt", POSE)
    np.testing.assert_allclose(read_pose(tmp_path / "a.txt"), POSE, rtol=0, atol=2e-15)
    np.testing.assert_array_equal(read_pose(tmp_path / "a.txt")[:3, 3], POSE[:3, 3])


def test_seven_scenes_text_by_hand(tmp_path):
    path = tmp_path / "frame-000000.pose.txt"
    path.write_text(" 0 -1 0\t1.5 \n1 0 0 2\n 0.000e+00 0 1 -3\r\n0 0 0 1\n\n")
    expected = [[0, -1, 0, 1.5], [1, 0, 0, 2], [0, 0, 1, -3], [0, 0, 0, 1]]
    np.testing.assert_allclose(read_pose(path), expected, atol=1e-13)


def test_a_rounded_rotation_becomes_the_nearest_true_one():
    rough = np.round(POSE, 3)
    exact = rigid_transform(rough)
    rotation = exact[:3, :3]
    np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=3e-15)
    assert np.linalg.det(rotation) == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(rotation, Rotation.from_matrix(rough[:3, :3]).as_matrix(), atol=1e-3)
    # nearest (Frobenius): the remainder R^T A is symmetric
    remainder = rotation.T @ rough[:3, :3]
    np.testing.assert_allclose(remainder, remainder.T, atol=3e-15)
    np.testing.assert_array_equal(exact[:, 3], rough[:, 3])
    assert rough[0, 0] == round(POSE[0, 0], 3)  # the caller's matrix is as it was


BAD = {
    "": "0 words",
    "1 " * 17: "17 words",
    "a " + "1 " * 15: "not a number",
    "1 0 0 nan 0 1 0 0 0 0 1 0 0 0 0 1": "not finite",
    "1 0 0 1 0 1 0 2 0 0 1 3 0 0 0 2": "last row",
    "1 0 0 0 0 1 0 0 0 0 1 0 1 2 3 1": "last row",  # column by column
    "1.02 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1": "not orthonormal",
    "1e300 0 0 0 0 1e300 0 0 0 0 1e300 0 0 0 0 1": "not orthonormal",
    "1 0 0 0 0 1 0 0 0 0 -1 0 0 0 0 1": "is a reflection",
}


@pytest.mark.parametrize("text", BAD)
def test_bad_pose_files(text, tmp_path):
    path = tmp_path / "frame-000007.pose.txt"
    path.write_text(text)
    with pytest.raises(InvalidPose, match=r"frame-000007\.pose\.txt: .*" + BAD[text]) as caught:
        read_pose(path)
    assert "\n" not in str(caught.value)


def test_no_pose_file(tmp_path):
    with pytest.raises(InvalidPose, match=r"a\.txt: .*No such file"):
        read_pose(tmp_path / "a.txt")
    (tmp_path / "b.txt").write_bytes(b"\x00\xff\x89")
    with pytest.raises(InvalidPose, match=r"b\.txt: .*not UTF-8 text"):
        read_pose(tmp_path / "b.txt")


@pytest.mark.parametrize("matrix", [np.eye(3), np.ones(16), [["a"] * 4] * 4, [[1], [2, 3]], None])
def test_bad_matrices(matrix):
    with pytest.raises(InvalidPose):
        rigid_transform(matrix)


def test_only_whole_poses_are_written(tmp_path):
    with pytest.raises(InvalidPose):
        write_pose(tmp_path / "a.txt", np.zeros((4, 4)))
    assert list(tmp_path.iterdir()) == []


# ---- trajectories


def test_slerp_by_hand():
    # 90 deg about z within 1 s; a third of the way is 30 deg
    trajectory = SensorTrajectory(
        np.array([10.0, 11.0]),
        np.array([[0.0, 0.0, 0.0], [3.0, -6.0, 9.0]]),
        np.array([[0, 0, 0, 1.0], [0, 0, HALF, HALF]]),
    )
    a, b, c = interpolate(trajectory, [10.0, 10.0 + 1 / 3, 11.0], longest_gap=1.0)
    r = math.sqrt(3) / 2
    np.testing.assert_allclose(a, np.eye(4), atol=1e-13)
    np.testing.assert_allclose(
        b, [[r, -0.5, 0, 1], [0.5, r, 0, -2], [0, 0, 1, 3], [0, 0, 0, 1]], atol=1e-12
    )
    np.testing.assert_allclose(
        c, [[0, -1, 0, 3], [1, 0, 0, -6], [0, 0, 1, 9], [0, 0, 0, 1]], atol=1e-13
    )


def test_quaternion_order_by_hand(tmp_path):
    path = tmp_path / "groundtruth.txt"
    path.write_text("# t tx ty tz qx qy qz qw\n1.0 1 2 3 1 0 0 0\n")  # half a turn about x
    (pose,) = interpolate(read_trajectory(path), [1.0])
    np.testing.assert_allclose(
        pose, [[1, 0, 0, 1], [0, -1, 0, 2], [0, 0, -1, 3], [0, 0, 0, 1]], atol=1e-13
    )


def test_nothing_is_made_up():
    one = np.tile([0.0, 0.0, 0.0, 1.0], (4, 1))
    trajectory = SensorTrajectory(np.array([1.0, 1.05, 2.0, 2.05]), np.eye(4)[:, :3], one)
    stamps = [0.99, 1.0, 1.02, 1.05, 1.06, 1.99, 2.0, 2.05, 2.06, math.nan]
    known = [pose is not None for pose in interpolate(trajectory, stamps)]
    assert known == [False, True, True, True, False, False, True, True, False, False]
    wide = interpolate(trajectory, stamps, longest_gap=1.0)
    assert [pose is not None for pose in wide] == [False, *[True] * 7, False, False]
    assert interpolate(trajectory, []) == []


def test_a_near_pose_stands_where_nothing_is_interpolated():
    one = np.tile([0.0, 0.0, 0.0, 1.0], (3, 1))
    positions = np.array([[1.0, 0, 0], [2.0, 0, 0], [4.0, 0, 0]])
    trajectory = SensorTrajectory(np.array([1.0, 1.03, 2.0]), positions, one)
    stamps = [0.97, 0.985, 1.015, 1.049, 1.06, 1.981, 1.9999999, 2.019, 2.021, math.nan]
    poses = interpolate(trajectory, stamps, tolerance=0.02)
    result = [None if pose is None else round(pose[0, 3], 9) for pose in poses]
    assert result == [None, 1.0, 1.5, 2.0, None, 4.0, 4.0, 4.0, None, None]


def test_trajectory_files(tmp_path):
    path = tmp_path / "groundtruth.txt"
    path.write_text("# a\n\n2.5 4 5 6 0 0 0.7071 0.7071\n1.5 1 2 3 0 0 0 1\n1.5 1.09 2 3 0 0 0 1\n")
    trajectory = read_trajectory(path)
    assert trajectory.stamps.tolist() == [1.5, 2.5]
    assert trajectory.positions.tolist() == [[1, 2, 3], [4, 5, 6]]
    np.testing.assert_allclose(trajectory.quaternions, [[0, 0, 0, 1], [0, 0, HALF, HALF]])


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("1 2 3", "line 2: .*3 words"),
        ("nan 2 3 4 0 0 0 1", "line 2: .*not finite"),
        ("1 inf 3 4 0 0 0 1", "line 2: .*not finite"),
        ("1 2 3 4 0 0 0 0", "line 2: .*unit length"),
        ("# only comments", "has no pose"),
        ("1.7e18 2 3 4 0 0 0 1", r"time stamp 1\.7e\+18 is not in seconds"),
        ("2 1.11 2 3 0 0 0 1", r"line 3: The position is 0\.11 m from that of an earlier line"),
    ],
)
def test_bad_trajectories(line, message, tmp_path):
    path = tmp_path / "groundtruth.txt"
    good = "" if line.startswith("#") else "2 1 2 3 0 0 0 1\n"
    path.write_text(f"# comment\n{line}\n{good}")
    with pytest.raises(InvalidPose, match=r"groundtruth\.txt.*" + message):
        read_trajectory(path)
