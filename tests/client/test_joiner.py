"""Tests of joined scans: motion within a scan, windows, and what is left out."""

from functools import partial

import numpy as np
import pytest

from sceneprint_client.joiner import MOST_SCANS, Joiner, window_start
from sceneprint_client.poses import rotation_of
from sceneprint_client.transforms import TransformTree

SECOND = 1_000_000_000


def pose(x, y=0.0, yaw=0.0):
    T = np.eye(4)
    T[:3, :3] = rotation_of(np.array([0, 0, np.sin(yaw / 2), np.cos(yaw / 2)]))
    T[:3, 3] = x, y, 0
    return T


def along_x(metres_per_second, *, yaw=0.0):
    def odometry(stamps_ns):
        return [pose(metres_per_second * ns / SECOND, 0.0, yaw * ns / SECOND) for ns in stamps_ns]

    return Joiner(odometry, 2.0)


def test_points_of_a_moving_scan_by_hand():
    """At 10 m/s, a wall seen at x = 5 after 0.1 s is 6 m ahead of the sensor at the stamp."""
    joiner = along_x(10.0)
    points = np.array([[6.0, 0, 0], [5.5, 1, 0], [5.0, 2, 0]])
    assert joiner.add(SECOND, points, np.array([0.0, 0.05, 0.1]))
    np.testing.assert_allclose(joiner.cloud(), [[6, 0, 0], [6, 1, 0], [6, 2, 0]], atol=1e-6)
    # times before the stamp, as of drivers that stamp the end of a scan
    assert joiner.add(2 * SECOND, points + np.array([0, 10, 0]), np.array([-0.1, -0.05, 0.0]))
    assert len(joiner) == 1  # the sensor moved 10 m between the scans
    np.testing.assert_allclose(joiner.cloud(), [[5, 10, 0], [5, 11, 0], [5, 12, 0]], atol=1e-6)


def test_a_quarter_turn_by_hand():
    """At a quarter turn a second, a point ahead after a tenth is 9 degrees to the left."""
    joiner = along_x(0.0, yaw=np.pi / 2)
    assert joiner.add(0, np.array([[10.0, 0, 0]]), np.array([0.1]))
    angle = np.radians(9)
    expected = [[10 * np.cos(angle), 10 * np.sin(angle), 0]]
    np.testing.assert_allclose(joiner.cloud(), expected, atol=1e-5)


def test_scans_of_the_last_metres_are_joined_and_thinned():
    joiner = along_x(1.0)
    for i in range(5):  # one wall, seen from every metre
        assert joiner.add(i * SECOND, np.array([[10.0 - i, 0.05, 0.05], [10.0 - i, i + 0.5, 0.05]]))
    assert len(joiner) == 3  # at 2, 3 and 4 m
    result = joiner.cloud()
    # the newest scan comes first, and one point remains of those in the common voxel
    expected = [[6, 0.05, 0.05], [6, 4.5, 0.05], [6, 3.5, 0.05], [6, 2.5, 0.05]]
    np.testing.assert_allclose(result, expected, atol=1e-5)
    assert joiner.counts == {"scans": 5, "without_odometry": 0, "untimed": 5, "restarts": 0}
    assert result.dtype == np.float32


def test_windows_end_at_a_length_or_a_number():
    line = np.array([[x, 0.0, 0.0] for x in (0, 1, 2, 2.5, 4)])
    assert [window_start(line, metres) for metres in (0.5, 1.5, 2.0, 9.0)] == [4, 3, 2, 0]
    assert window_start(np.zeros((MOST_SCANS + 7, 3)), 1.0) == 7


def test_scans_that_the_odometry_does_not_cover_are_left_out():
    tree = TransformTree()
    for t, x in ((0.0, 0.0), (0.2, 0.2), (0.4, 30.0), (0.6, 30.2), (0.8, 30.4), (2.8, 30.5)):
        tree.add("odom", "lidar", round(t * SECOND), [x, 0, 0, 0, 0, 0, 1], fixed=False)
    joiner = Joiner(partial(tree.poses, "odom", "lidar"), 100.0)
    points, seconds = np.ones((2, 3)), np.array([0.0, 0.1])
    accepted = [
        joiner.add(round(t * SECOND), points, seconds)
        for t in (
            -1.0,  # before the first sample
            0.05,
            0.15,  # its end lies within the jump
            0.45,  # after the jump, which the earlier scan did not see
            0.75,  # its end lies in the gap
            2.75,
        )
    ]
    assert accepted == [False, True, False, True, False, False]
    assert len(joiner) == 1
    assert joiner.counts == {"scans": 6, "without_odometry": 4, "untimed": 0, "restarts": 1}


@pytest.mark.parametrize("last", [1.5, -1.5, 1e9, np.nan, np.inf])
def test_times_that_are_not_seconds_of_one_scan_are_refused(last):
    joiner = along_x(1.0)
    with pytest.raises(ValueError, match="from the stamp of its scan"):
        joiner.add(0, np.ones((2, 3)), np.array([0.0, last]))
    assert joiner.add(0, np.ones((2, 3)), np.array([0.0, 1.0]))
    assert len(joiner) == 1


def test_a_jump_within_a_scan_of_other_odometry_is_found():
    def odometry(stamps_ns):
        return [pose(0.0 if ns < SECOND // 20 else 1.0) for ns in stamps_ns]

    joiner = Joiner(odometry)
    assert not joiner.add(0, np.ones((2, 3)), np.array([0.0, 0.1]))
    assert joiner.add(SECOND // 10, np.ones((2, 3)), np.array([0.0, 0.1]))
    assert joiner.counts["without_odometry"] == 1


def test_a_clock_that_is_set_back_starts_again():
    joiner = along_x(0.1)
    for stamp in (5, 6, 1):
        assert joiner.add(stamp * SECOND, np.full((1, 3), float(stamp)))
    assert joiner.counts["restarts"] == 1
    np.testing.assert_array_equal(joiner.cloud(), [[1, 1, 1]])


@pytest.mark.parametrize("count", [0, 1])
def test_small_scans(count):
    joiner = along_x(1.0)
    assert joiner.cloud().shape == (0, 3)
    assert joiner.add(0, np.ones((count, 3)), np.zeros(count))
    assert joiner.cloud().shape == (count, 3)
