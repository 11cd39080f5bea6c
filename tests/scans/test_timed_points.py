"""Tests of the times of points, and of CustomMsg of Livox."""

import numpy as np
import pytest

from sceneprint.errors import UnreadableCloud
from sceneprint_client.files import read_livox_scan
from sceneprint_client.ros_messages import cloud_points, timed_points
from tests.scans.conftest import rows_of

SECONDS = np.linspace(0.0, 0.099, 12)
XYZ = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]


@pytest.mark.parametrize(
    ("name", "kind", "unit", "epoch"),
    [
        ("t", "<u4", 1e9, 0),  # Ouster
        ("time", "<f4", 1, 0),  # Velodyne
        ("timestamp", "<f8", 1, 1),  # Hesai, RoboSense
        ("timestamp", "<f8", 1e9, 1),  # PointCloud2 of Livox
        ("offset_time", "<u4", 1e9, 0),
    ],
)
def test_times_of_drivers(name, kind, unit, epoch, points, ros):
    rows = rows_of(points + 10, [*XYZ, ("ring", "<u2"), (name, kind)])
    rows[name] = np.round((SECONDS + epoch * (ros.start + 1.5)) * unit, 6)
    rows["x"][3] = np.nan
    writer = ros.messages()
    writer.points(1.5, rows)
    actual, seconds = timed_points(writer.last())
    rest = np.arange(12) != 3
    np.testing.assert_array_equal(actual, points[rest] + 10)
    assert seconds is not None
    np.testing.assert_allclose(seconds, SECONDS[rest], atol=1e-6)


def test_times_of_another_clock_begin_at_the_stamp(points, ros):
    rows = np.zeros(len(points), [*XYZ, ("timestamp", "<f8")])
    rows["x"], rows["timestamp"] = 1.0, 55.0 + SECONDS  # seconds since the start of the sensor
    writer = ros.messages()
    writer.points(1.5, rows)
    np.testing.assert_allclose(timed_points(writer.last())[1], SECONDS, atol=1e-6)


@pytest.mark.parametrize("step", [0.2, np.nan])
def test_times_that_no_scan_takes_are_ignored(step, points, ros):
    rows = np.zeros(len(points), [*XYZ, ("time", "<f4")])
    rows["x"], rows["time"] = 1.0, step * np.arange(12)
    writer = ros.messages()
    writer.points(1.5, rows)
    actual, seconds = timed_points(writer.last())
    assert len(actual) == 12
    assert seconds is None


def livox_bytes(writer, serialization):
    name, message = writer.written[-1][1:]
    if serialization == "ros1":
        return bytes(writer.types.serialize_ros1(message, name))
    return bytes(writer.types.serialize_cdr(message, name, little_endian=serialization == "little"))


@pytest.mark.parametrize("serialization", ["little", "big", "ros1"])
@pytest.mark.parametrize("frame", ["livox_frame", "l", "odd"])
@pytest.mark.parametrize("package", ["livox_ros_driver", "livox_ros_driver2"])
def test_livox_scans_are_read_as_rosbags_wrote_them(serialization, frame, package, points, ros):
    # first and second returns remain; third returns and points of low confidence do not
    tags = [0x00, 0x10, 0x20, 0x30, 0x0F, 0x12, 0x22, 0xC0, 0, 0, 0, 0]
    rest = np.array([not tag & 0x20 for tag in tags])
    ros1 = serialization == "ros1"
    writer = ros.messages(ros1=ros1)
    writer.livox(2.25, points + 10, SECONDS, tags, package=package, frame=frame)
    data = livox_bytes(writer, serialization)
    scan = read_livox_scan(data, ros1=ros1)
    assert scan.header == ((ros.start + 2, 250_000_000), frame)
    actual, seconds = timed_points(scan)
    np.testing.assert_array_equal(actual, (points + 10)[rest])
    np.testing.assert_allclose(seconds, SECONDS[rest], atol=1e-9)
    np.testing.assert_array_equal(cloud_points(scan), (points + 10)[rest])
    for end in range(len(data)):
        with pytest.raises(UnreadableCloud):
            read_livox_scan(data[:end], ros1=ros1)


def test_other_messages_are_no_livox_scans(points, ros):
    writer = ros.messages()
    writer.points(1.5, np.zeros(12, XYZ))
    for data in (b"", bytes(3), livox_bytes(writer, "little")):
        with pytest.raises(UnreadableCloud):
            read_livox_scan(data)
    writer.livox(0.0, points, SECONDS)
    writer.last().point_num = 11
    with pytest.raises(UnreadableCloud, match="declares 11 points, but holds 12"):
        read_livox_scan(livox_bytes(writer, "little"))
    writer.livox(0.0, points[:0], SECONDS[:0])
    actual, seconds = timed_points(read_livox_scan(livox_bytes(writer, "little")))
    assert (len(actual), seconds) == (0, None)
