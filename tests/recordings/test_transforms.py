"""Tests of recordings with faults in the clock or the transforms."""

import pickle
from itertools import pairwise

import numpy as np
import pytest

from sceneprint.errors import DatasetError
from sceneprint.formats.dataset import find_sequences
from sceneprint.formats.recording.selection import RecordingOptions
from tests.scans.conftest import rows_of

ALL = RecordingOptions(keyframe_m=0, keyframe_s=0)
IMAGE = np.full((60, 80), 2000, np.uint16)
MOUNTING = {("base_link", "camera"): np.eye(4)}


def sequences(ros, folder, fill, mounting=None, **how):
    def with_camera(writer):
        writer.camera_info(0.0)
        if mounting is not None:
            writer.transforms(0.0, mounting, "/tf_static")
        fill(writer)

    return find_sequences(ros.write(folder, with_camera, **how), ALL)


def positions(sequence):
    return [[round(float(x), 6) for x in frame.pose[:3, 3]] for frame in sequence.frames]


@pytest.mark.parametrize("container", ["mcap", "ros1"])
@pytest.mark.parametrize("source", ["odometry", "tf"])
def test_a_clock_that_is_set_back_splits_a_recording(source, container, tmp_path, ros):
    """A simulation is reset twice; each run drives along x, ten metres beside the one before."""

    def fill(writer):
        for run, last in enumerate((4, 3, 6)):
            writer.late = 60.0 * run
            for i in range(last):
                T = ros.transform(float(i), 10.0 * run, 0)
                if source == "tf":
                    writer.transforms(1 + 0.5 * i, {("odom", "base_link"): T})
                else:
                    writer.odometry(1 + 0.5 * i, T)
                writer.image(1.2 + 0.5 * i, IMAGE)

    runs = sequences(ros, tmp_path, fill, MOUNTING, container=container)
    assert [run.name for run in runs] == ["run.part1", "run.part2", "run.part3"]
    assert [run.parent_frame for run in runs] == [f"run.part{i}/odom" for i in (1, 2, 3)]
    # the last frame of each run lies after its last sample, and not before those of the next run
    assert [positions(run) for run in runs] == [
        [[0.4 + i, 10.0 * run, 0.0] for i in range(last - 1)] for run, last in enumerate((4, 3, 6))
    ]
    assert [frame.name for frame in runs[1].frames] == ["run.part2/000004", "run.part2/000005"]
    assert runs[0].note == (
        "10 of 13 frames of /camera/depth/image_raw used, poses of 10 of 13 frames in odom; 3 "
        "without: no sample of odom -> base_link within 20 ms (nearest 0.2 s); skipped: 3 without "
        "a pose; split into 3 parts, because stamps jump back"
    )


def test_stamps_that_are_out_of_order_by_little_split_nothing(tmp_path, ros):
    def fill(writer):
        for i in (0, 1, 3, 2, 4):
            t = 1 + 0.05 * i
            writer.late = 1.0 + 0.1 * len(writer.connections) - t
            writer.transforms(t, {("odom", "base_link"): ros.transform(0.1 * i, 0, 0)})
            writer.image(t, IMAGE)

    (sequence,) = sequences(ros, tmp_path, fill, MOUNTING)
    assert sorted(positions(sequence)) == [[round(0.1 * i, 6), 0, 0] for i in range(5)]


def test_two_publishers_with_delays_of_their_own_split_nothing(tmp_path, ros):
    """Both say the same; the stamps of one are a second ahead."""

    def fill(writer):
        for i in range(40):
            for ahead in (0.0, 1.0):
                t = 0.1 * i + ahead
                writer.late = -ahead
                writer.transforms(t, {("odom", "base_link"): ros.transform(t, 0, 0)})
            writer.late = 0.0
            writer.image(0.1 * i, IMAGE)

    (sequence,) = sequences(ros, tmp_path, fill, MOUNTING)
    assert positions(sequence) == [[round(0.1 * i, 6), 0, 0] for i in range(40)]


@pytest.mark.parametrize(
    ("period", "order"), [(0.1, "AB"), (0.1, "AABB"), (0.02, "BAAAA"), (0.4, "AB")]
)
def test_two_publishers_that_contradict_each_other(period, order, tmp_path, ros):
    def fill(writer):
        for i in range(36):
            t, robot = period * i, order[i % len(order)]
            T = ros.transform(0.2 * t, 0.0 if robot == "A" else 8.0, 0)
            writer.transforms(t, {("odom", "base_link"): T})
            if i:
                writer.image(t - 0.3 * period, IMAGE)

    with pytest.raises(DatasetError) as caught:
        sequences(ros, tmp_path, fill, MOUNTING)
    assert (
        "0 of 35 frames of /camera/depth/image_raw used, poses of 0 of 35 frames; 35 without: "
        "samples of odom -> base_link contradict each other (two publishers, or 50 m/s)"
    ) in str(caught.value)
    assert str(caught.value).endswith("select another frame with --pose-frame.")


def test_frames_within_a_jump_are_left_out(tmp_path, ros):
    """20 m within 0.1 s; before and after it the robot drives at 5 m/s, stops and turns back."""
    x = [0, 0.5, 1, 1.5, 21.5, 22, 22.4, 22.5, 22.4, 22, 21.5]

    def fill(writer):
        for i, one in enumerate(x):
            writer.transforms(0.1 * i, {("odom", "base_link"): ros.transform(one, 0, 0)})
            if i:
                writer.image(0.1 * i - 0.05, IMAGE)

    (sequence,) = sequences(ros, tmp_path, fill, MOUNTING)
    middle = [[round((a + b) / 2, 6), 0, 0] for a, b in pairwise(x)]
    assert positions(sequence) == [*middle[:3], *middle[4:]]
    assert "1 without: samples of odom -> base_link contradict each other" in sequence.note
    assert "skipped: 1 without a pose" in sequence.note
    assert "odom -> base_link jumps by 20 m or rad" in sequence.note


def test_samples_at_the_stamps_of_frames_are_too_fast(tmp_path, ros):
    x = [0.0, 100.0, 200.0, 201.0, 202.0, 303.0]  # metres, in seconds

    def fill(writer):
        for i, at in enumerate(x):
            writer.transforms(1.0 * i, {("odom", "base_link"): ros.transform(at, 0, 0)})
            writer.image(1.0 * i, IMAGE)

    (sequence,) = sequences(ros, tmp_path, fill, MOUNTING)
    assert positions(sequence) == [[at, 0, 0] for at in (200.0, 201.0, 202.0)]
    assert "3 without: samples of odom -> base_link contradict each other" in sequence.note
    assert sequence.lost == 3


@pytest.mark.parametrize(
    ("child", "frame", "shift_s", "why"),
    [
        (
            "base_link",
            "velodyne",
            0.0,
            "(moving frames: base_link, camera; is /tf_static recorded?",
        ),
        ("base_link", "", 0.0, "their messages do not name a coordinate frame (frame_id)"),
        ("base_link", "camera", 1e6, "no sample of odom -> base_link within 20 ms (nearest 1e+06"),
        ("", "camera", 0.0, "/odom is ignored because its child_frame_id is empty"),
    ],
)
def test_frames_that_miss_the_poses_of_the_recording_are_lost(
    child, frame, shift_s, why, tmp_path, ros
):
    def fill(writer):
        for i in range(3):
            writer.image(1.0 * i, IMAGE, frame=frame)
        for i in range(3):
            writer.odometry(i + shift_s, ros.transform(1.0 * i, 0, 0), child=child)

    (sequence,) = sequences(ros, tmp_path, fill, MOUNTING)
    assert sequence.lost == len(sequence.frames) == 3
    assert why in sequence.note


@pytest.mark.parametrize("length", [0.0, 0.5, 1.02, float("nan")])
def test_quaternions_that_are_not_of_length_1(length, tmp_path, ros):
    def fill(writer):
        writer.transforms(0.0, {("base_link", "camera"): ros.camera}, "/tf_static", length=length)
        for i in range(3):
            writer.odometry(0.1 * i, ros.transform(float(i), 0, 0))
            writer.image(0.1 * i, IMAGE)

    (sequence,) = sequences(ros, tmp_path, fill)
    if length == 1.02:
        assert sequence.note.endswith(
            "base_link -> camera is normalised: its quaternion has the length 1.02"
        )
        expected = ros.transform(2, 0, 0) @ ros.camera
        np.testing.assert_allclose(sequence.frames[2].pose, expected, atol=1e-9)
        assert sequence.lost == 0
    else:
        assert sequence.lost == 3
        assert [frame.pose for frame in sequence.frames] == [None] * 3
        assert sequence.note.endswith(
            "poses of 0 of 3 frames; 3 without: there are no transforms from camera to a frame in "
            "which it moves; base_link -> camera is ignored because its quaternion has the length "
            f"{length:.3g}"
        )


@pytest.mark.parametrize("other", ["/tf_static", "/tf"])
def test_a_fixed_transform_with_two_values_is_passed_over(other, tmp_path, ros):
    def fill(writer):
        writer.transforms(0.0, {("base_link", "camera"): ros.transform(0, 0, 1)}, "/tf_static")
        writer.transforms(0.0, {("base_link", "camera"): ros.transform(0, 0, 1.3)}, other)
        for i in range(3):
            writer.odometry(0.1 * i, ros.transform(float(i), 0, 0))
            writer.image(0.1 * i, IMAGE)

    (sequence,) = sequences(ros, tmp_path, fill)
    assert [frame.pose for frame in sequence.frames] == [None] * 3
    assert sequence.note.endswith(
        "base_link -> camera is ignored because it is static, but has values that differ by 0.3 m "
        "or rad"
    )


# Points in the frame of the world.


def registered(ros, writer, *, frame, tf, leaf=""):
    """Points ahead of a LiDAR that drives along a bend, in the frame of the world."""
    if tf:
        fixed = {("body", "lidar"): ros.transform(0.1, 0, 0.4)}
        fixed |= {("body", leaf): np.eye(4)} if leaf else {}
        writer.transforms(0.0, fixed, "/tf_static")
    for i in range(4):
        T = ros.transform(3.0 * i, 0.5 * i, 1, 0, 0, np.sin(0.2 * i), np.cos(0.2 * i))
        if tf:
            writer.transforms(float(i), {(frame, "body"): T})
        T_world_lidar = T @ ros.transform(0.1, 0, 0.4)
        points = SEEN @ T_world_lidar[:3, :3].T + T_world_lidar[:3, 3]
        rows = rows_of(points, [(name, "<f8") for name in "xyz"])
        writer.points(float(i), rows, "/cloud_registered", frame=frame)


SEEN = np.array([[4.0 + 0.2 * i, i % 3 - 1.0, 0.1 * i] for i in range(12)])


@pytest.mark.parametrize("frame", ["camera_init", "odom", "start"])
def test_registered_clouds_are_taken_back_to_their_sensor(frame, tmp_path, ros):
    (sequence,) = sequences(
        ros, tmp_path, lambda writer: registered(ros, writer, frame=frame, tf="yes")
    )
    assert sequence.parent_frame == f"run/{frame}"
    assert sequence.note.endswith(f"; points are transformed from {frame} to their sensor, lidar")
    for i, one in enumerate(sequence.frames):
        np.testing.assert_allclose(one.read().points, SEEN, atol=1e-5)
        T = ros.transform(3.0 * i, 0.5 * i, 1, 0, 0, np.sin(0.2 * i), np.cos(0.2 * i))
        np.testing.assert_allclose(one.pose, T @ ros.transform(0.1, 0, 0.4), atol=1e-9)
    travelled = pickle.loads(pickle.dumps(sequence.frames[3]))
    assert travelled.read_bytes() == sequence.frames[3].read_bytes()


def test_registered_clouds_of_an_unknown_sensor_are_refused(tmp_path, ros):
    path = ros.write(tmp_path, lambda w: registered(ros, w, frame="camera_init", tf=""))
    with pytest.raises(DatasetError, match=r"are in camera_init, .* Record /tf or odometry"):
        find_sequences(path, ALL)
    two = ros.write(
        tmp_path / "two", lambda w: registered(ros, w, frame="map", tf="yes", leaf="camera")
    )
    with pytest.raises(DatasetError, match="Select one of camera, lidar with --sensor-frame"):
        find_sequences(two, ALL)
    (sequence,) = find_sequences(two, RecordingOptions(keyframe_m=0, sensor_frame="lidar"))
    np.testing.assert_allclose(sequence.frames[2].read().points, SEEN, atol=1e-5)
    with pytest.raises(DatasetError, match="'wheel' is not below"):
        find_sequences(two, RecordingOptions(sensor_frame="wheel"))


def test_points_in_the_base_of_a_robot_with_an_arm_stay_there(tmp_path, ros):
    rows = np.ones(12, [("x", "<f4"), ("y", "<f4"), ("z", "<f4")])

    def fill(writer):
        for i in range(3):
            writer.transforms(0.1 * i, {("base_link", "hand"): ros.transform(0.1 * i, 0, 1)})
            writer.points(0.1 * i, rows, frame="base_link")

    (sequence,) = sequences(ros, tmp_path, fill)
    assert [frame.pose for frame in sequence.frames] == [None] * 3
    np.testing.assert_array_equal(sequence.frames[2].read().points, np.ones((12, 3)))
