"""Tests of scans of a recording that are joined by odometry, from messages to poses."""

import pickle

import numpy as np
import pytest

from sceneprint.errors import DatasetError, UnreadableCloud
from sceneprint.formats.dataset import find_sequences
from sceneprint.formats.recording.selection import RecordingOptions
from tests.scans.conftest import rows_of

JOINED = RecordingOptions(join_m=2.05, keyframe_m=0.5)
#: Interval of scans, of which each takes the whole interval, and of odometry, seconds.
SCAN_S, ODOMETRY_S = 0.1, 0.01


def pose(t, phase=0.0, side=0.0):
    """A drive along x at 1 m/s that turns to both sides by up to 34 degrees a second."""
    yaw = 0.4 * np.sin(1.5 * t + phase)
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T[:3, 3] = t, side, 0
    return T


def skewed(points, t, seconds, **drive):
    """Return points (N, 3) of the world as a moving sensor measures them, each at its time."""
    measured = np.empty_like(points)
    for i, moment in enumerate(t + seconds):
        T = np.linalg.inv(pose(moment, **drive))
        measured[i] = T[:3, :3] @ points[i] + T[:3, 3]
    return measured


def write_odometry(writer, count, **drive):
    writer.transforms(0.0, {("base_link", "livox_frame"): np.eye(4)}, "/tf_static")
    for k in range(10 * count + 11):
        t = ODOMETRY_S * k
        writer.transforms(t, {("odom", "base_link"): pose(t, **drive)})


def wall(number):
    """Twenty points of the world that scan `number` sees, each in a voxel of its own."""
    return np.array([[12.05, 0.5 * i - 5 + 0.05, 0.1 * number + 0.05] for i in range(20)])


def write_walls(writer, kind):
    seconds = np.linspace(0.0, 0.0999, 20)
    write_odometry(writer, 30)
    for number in range(30):
        t = SCAN_S * number
        points = skewed(wall(number), t, seconds)
        if kind == "livox_ros_driver" or kind == "livox_ros_driver2":
            writer.livox(t, points, seconds, package=kind)
            continue
        names = ["x", "y", "z", *([] if kind == "untimed" else [kind])]
        rows = rows_of(points, [(name, "<u4" if name == "t" else "<f4") for name in names])
        if kind != "untimed":
            rows[kind] = np.round(seconds * (1e9 if kind == "t" else 1), 9)
        writer.points(t, rows, "/livox/lidar", frame="livox_frame")


def check_walls(sequence, tolerance):
    """Each frame has the walls of its scans, in the axes of the newest."""
    for frame in sequence.frames:
        scans = range(frame.sequence, max(frame.sequence - 21, -1), -1)
        world = np.concatenate([wall(number) for number in scans])
        T = np.linalg.inv(frame.pose)
        points = frame.read().points
        assert len(points) == len(world)
        assert np.abs(points - (world @ T[:3, :3].T + T[:3, 3])).max() < tolerance


@pytest.mark.parametrize(
    ("kind", "container"),
    [
        ("livox_ros_driver", "ros1"),
        ("livox_ros_driver2", "mcap"),
        ("livox_ros_driver2", "sqlite3"),
        ("t", "mcap"),
        ("time", "ros1"),
    ],
)
def test_scans_are_joined_without_their_motion(kind, container, tmp_path, ros):
    path = ros.write(tmp_path, lambda writer: write_walls(writer, kind), container)
    (sequence,) = find_sequences(path, JOINED)
    median = np.median([min(frame.sequence + 1, 21) for frame in sequence.frames])
    assert sequence.note == (
        f"{len(sequence.frames)} of 30 frames of /livox/lidar used, poses of 30 of 30 frames in "
        f"odom; skipped: {30 - len(sequence.frames)} between keyframes; each frame joins the scans "
        f"of 2.05 m (a median of {median:g} scans), corrected for motion"
    )
    check_walls(sequence, 1e-3)
    travelled = pickle.loads(pickle.dumps(sequence.frames[-1]))
    assert travelled.read_bytes() == sequence.frames[-1].read_bytes()


def test_registered_scans_are_joined_as_they_are(tmp_path, ros):
    """Points in the world frame, as of FAST-LIO, whose times would move them twice."""

    def fill(writer):
        for number in range(30):
            t = SCAN_S * number
            writer.transforms(t, {("camera_init", "body"): pose(t)})
            rows = rows_of(wall(number), [(name, "<f4") for name in ("x", "y", "z", "time")])
            rows["time"] = np.linspace(0.0, 0.0999, 20)
            writer.points(t, rows, "/cloud_registered", frame="camera_init")

    (sequence,) = find_sequences(ros.write(tmp_path, fill), JOINED)
    assert sequence.frames[-1].sequence == 25
    check_walls(sequence, 1e-3)


def test_untimed_scans_keep_their_motion(tmp_path, ros):
    path = ros.write(tmp_path, lambda writer: write_walls(writer, "untimed"))
    (sequence,) = find_sequences(path, JOINED)
    assert sequence.note.endswith(", without correction for motion")
    with pytest.raises(AssertionError):
        check_walls(sequence, 0.05)  # 3.4 degrees in a scan move points at 12 m by 0.7 m
    check_walls(sequence, 1.0)


def test_what_cannot_be_joined_is_refused(tmp_path, ros):
    def alone(writer):
        writer.livox(0.0, wall(0), np.zeros(20))

    with pytest.raises(DatasetError, match="Joining scans requires odometry: omit --join-m"):
        find_sequences(ros.write(tmp_path / "alone", alone), JOINED)

    def images(writer):
        writer.camera_info(0.0)
        writer.image(0.0, np.full((60, 80), 2000))

    with pytest.raises(DatasetError, match="but --join-m joins only scans"):
        find_sequences(ros.write(tmp_path / "images", images), JOINED)


def test_a_damaged_scan_is_left_out(tmp_path, ros):
    def fill(writer):
        write_odometry(writer, 3)
        name = "livox_ros_driver2/msg/CustomMsg"
        for number in range(3):
            writer.livox(SCAN_S * number, wall(number), np.zeros(20))
            if number == 1:  # recorded again without its end, and with the same stamp
                data = writer.serialized(name, writer.livox_message(0.15, wall(1), np.zeros(20)))
                writer.raw("/livox/lidar", name, 0.15, data[:-40])

    path = ros.write(tmp_path, fill)
    (sequence,) = find_sequences(path, RecordingOptions(join_m=2.0, keyframe_m=0))
    assert [len(one.read().points) for one in (*sequence.frames[:2], sequence.frames[3])] == [
        20, 40, 60
    ]  # fmt: skip
    with pytest.raises(UnreadableCloud, match="The scan is damaged, or the odometry has a gap"):
        sequence.frames[2].read()


def test_empty_and_damaged_scans_at_the_start_change_nothing(tmp_path, ros):
    def fill(writer):
        rows = np.zeros(1, [("x", "<f4")])  # without y and z
        writer.points(-0.3, rows, "/livox/lidar", frame="livox_frame")
        rows = np.zeros(0, [(name, "<f4") for name in ("x", "y", "z", "time")])
        writer.points(-0.2, rows, "/livox/lidar", frame="livox_frame")
        write_walls(writer, "time")

    (sequence,) = find_sequences(ros.write(tmp_path, fill), JOINED)
    assert sequence.note.endswith(", corrected for motion")
