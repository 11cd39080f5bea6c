"""Tests that bags in all containers and encodings give the poses and samples of the folder."""

from functools import partial

import numpy as np
import pytest

from sceneprint.errors import DatasetError, InvalidIntrinsics, UnreadableFrame
from sceneprint.formats.dataset import Layout, find_sequences
from sceneprint.formats.dataset.frame_reference import session_of
from sceneprint.formats.recording.outline import bag_outline
from sceneprint.formats.recording.selection import RecordingOptions
from sceneprint.types import DepthFrame
from sceneprint_client.frame_files import meta_of
from tests.scans.conftest import rows_of

ALL = RecordingOptions(keyframe_m=0)


def only(path, options=ALL):
    (sequence,) = find_sequences(path, options)
    return sequence


def angle(a, b):
    turn = a[:3, :3].T @ b[:3, :3]
    return float(np.degrees(np.linalg.norm(turn - turn.T) / np.sqrt(8)))


def drive(writer, ros, walk, put):
    """A robot with a camera off its base: its frames lie between the stamps of its odometry."""
    writer.transforms(0.0, {("base_link", "camera"): ros.camera}, "/tf_static")
    for i, (t, T) in enumerate(walk):
        writer.transforms(t, {("odom", "base_link"): T})
        writer.camera_info(t)
        put(writer, i, t)


@pytest.mark.parametrize("container", ["mcap", "sqlite3", "ros1"])
@pytest.mark.parametrize(
    ("encoding", "how"),
    [
        ("16UC1", {}), ("mono16", {"padding": 6}), ("16UC1", {"big": True, "padding": 1}),
        ("16UC1", {"compressed": True}),
    ],
)  # fmt: skip
def test_poses_and_samples_are_those_that_were_recorded(
    container, encoding, how, tmp_path, ros, walk, depth
):
    def put(writer, i, t):
        if how.get("compressed"):
            writer.compressed(t, depth(i))
        else:
            writer.image(t, depth(i), encoding, **how)

    path = ros.write(tmp_path, lambda writer: drive(writer, ros, walk, put), container)
    sequence = only(path)
    assert (sequence.name, sequence.layout) == ("run", Layout.RECORDING)
    assert (sequence.parent_frame, session_of(sequence)) == ("run/odom", "run")
    assert [frame.name for frame in sequence.frames] == [f"run/{i:06d}" for i in range(len(walk))]
    for i, (reference, (t, T)) in enumerate(zip(sequence.frames, walk, strict=True)):
        frame = reference.read()
        assert isinstance(frame, DepthFrame)
        metres = (depth(i) / 1000.0).astype(np.float32)
        np.testing.assert_array_equal(frame.depth, metres)
        expected = T @ ros.camera
        assert np.linalg.norm(frame.pose[:3, 3] - expected[:3, 3]) < 1e-6
        assert angle(frame.pose, expected) < 1e-5
        assert reference.timestamp == pytest.approx(ros.start + t, abs=1e-6)
        k = frame.intrinsics
        assert (k.width, k.height, k.fx, k.fy, k.cx, k.cy) == (*ros.size, *ros.k)
        meta = meta_of(reference)
        assert meta.captured_at.timestamp() == pytest.approx(ros.start + t, abs=1e-6)
        assert meta.sequence == i
        topic, _, stamp = str(meta.name).rpartition("/")
        assert topic == "camera/depth/image_raw/compressedDepth"[: len(topic)]
        assert float(stamp) == pytest.approx(ros.start + t, abs=1e-6)
        assert meta.T_base_sensor.base_frame == "base_link"
        np.testing.assert_allclose(meta.T_base_sensor.matrix, ros.camera, atol=1e-9)


@pytest.mark.parametrize("compression", ["message", "file", "bz2", "lz4", "storage"])
def test_compressed_bags(compression, tmp_path, ros, walk, depth):
    container = {"bz2": "ros1", "lz4": "ros1", "storage": "mcap"}.get(compression, "sqlite3")

    def put(writer, i, t):
        writer.image(t, depth(i))

    path = ros.write(
        tmp_path, lambda writer: drive(writer, ros, walk, put), container, compression=compression
    )
    frames = only(path).frames
    assert len(frames) == len(walk)
    np.testing.assert_array_equal(frames[7].read().depth, (depth(7) / 1000).astype(np.float32))


def test_metres_are_taken_as_they_are(tmp_path, ros, walk, depth):
    def put(writer, i, t):
        metres = depth(i).astype(np.float32) / 777
        metres[depth(i) == 0] = np.nan
        writer.image(t, metres, "32FC1", padding=4 * (i % 3), big=i % 2 == 1)

    path = ros.write(tmp_path, lambda writer: drive(writer, ros, walk, put))
    for i, reference in enumerate(only(path).frames):
        expected = depth(i).astype(np.float32) / 777
        np.testing.assert_array_equal(reference.read().depth, expected)


@pytest.mark.parametrize("container", ["mcap", "sqlite3", "ros1"])
def test_points_have_the_pose_of_their_sensor(container, tmp_path, ros, walk):
    xyz = np.random.default_rng(3).uniform(-5, 5, (120, 3)).astype(np.float32)
    xyz[5], xyz[17, 1], xyz[40] = np.nan, np.inf, 0.0
    form = {
        "names": ["ring", "z", "intensity", "x", "y"], "offsets": [0, 2, 6, 10, 17],
        "formats": ["<u2", "<f4", "<f4", "<f4", "<f4"], "itemsize": 23,
    }  # fmt: skip
    rows = rows_of(xyz, np.dtype(form))

    def fill(writer):
        writer.transforms(0.0, {("base_link", "lidar"): ros.camera}, "/tf_static")
        for t, T in walk:
            writer.transforms(t, {("odom", "base_link"): T})
            writer.points(t, rows)

    cloud = only(ros.write(tmp_path, fill, container)).frames[2].read()
    present = np.isfinite(xyz).all(axis=1) & xyz.any(axis=1)
    assert present.sum() == 117
    np.testing.assert_array_equal(cloud.points, xyz[present])
    np.testing.assert_allclose(cloud.pose, walk[2][1] @ ros.camera, atol=1e-9)


def test_interpolation_by_hand(tmp_path, ros, depth):
    """A base that turns by 40 degrees and drives 2 m in 0.4 s, seen after 0.1 s and later."""
    turn = np.radians(20)

    def fill(writer):
        writer.camera_info(0.0)
        writer.transforms(0.0, {("base_link", "camera"): ros.transform(0.3, 0, 0.5)}, "/tf_static")
        writer.transforms(1.0, {("odom", "base_link"): ros.transform(1, 0, 0)})
        ahead = ros.transform(3, 0, 0, 0, 0, np.sin(turn), np.cos(turn))
        writer.transforms(1.4, {("odom", "base_link"): ahead})
        writer.transforms(2.0, {("odom", "base_link"): ros.transform(4, 0, 0)})
        for i, t in enumerate((0.97, 0.985, 1.1, 1.4, 1.7, 2.015, 2.03)):
            writer.image(t, depth(i))

    sequence = only(ros.write(tmp_path, fill))
    poses = {round(f.timestamp - ros.start, 3): f.pose for f in sequence.frames}
    # 1.7 lies in a gap of 0.6 s; 0.97 and 2.03 are more than 20 ms outside
    assert sorted(poses) == [0.985, 1.1, 1.4, 2.015]
    quarter = np.radians(10)
    c, s = np.cos(quarter), np.sin(quarter)
    expected = [[c, -s, 0, 1.5 + 0.3 * c], [s, c, 0, 0.3 * s], [0, 0, 1, 0.5], [0, 0, 0, 1]]
    np.testing.assert_allclose(poses[1.1], expected, atol=1e-9)
    np.testing.assert_allclose(poses[0.985][:3, 3], (1.3, 0, 0.5), atol=1e-9)
    np.testing.assert_allclose(poses[2.015][:3, 3], (4.3, 0, 0.5), atol=1e-9)
    assert sequence.note == (
        "4 of 7 frames of /camera/depth/image_raw used, poses of 4 of 7 frames in odom; 3 "
        "without: no sample of odom -> base_link within 20 ms (nearest 0.03 s); skipped: 3 "
        "without a pose"
    )
    assert sequence.lost == 3


def test_keyframes_by_hand(tmp_path, ros, depth):
    """0.3 m or 15 degrees from the last one that was taken, not from the last one."""
    x = (0, 0.2, 0.31, 0.4, 0.45, 0.45, 0.74, 0.76)
    places = zip(x, (0, 0, 0, 14, 16, 30, 16, 16), strict=True)

    def fill(writer):
        writer.camera_info(0.0)
        writer.transforms(0.0, {("base_link", "camera"): np.eye(4)}, "/tf_static")
        for i, (x, degrees) in enumerate(places):
            half = np.radians(degrees) / 2
            T = ros.transform(x, 0, 0, 0, 0, np.sin(half), np.cos(half))
            writer.transforms(0.1 * i, {("odom", "base_link"): T})
            writer.image(0.1 * i, depth(i))

    path = ros.write(tmp_path, fill)
    sequence = only(path, RecordingOptions())
    assert [f.name for f in sequence.frames] == [f"run/00000{i}" for i in (0, 2, 4, 7)]
    assert "4 of 8 frames" in sequence.note
    assert "4 between keyframes" in sequence.note
    wide = only(path, RecordingOptions(keyframe_m=10, keyframe_deg=29))
    assert [f.name for f in wide.frames] == ["run/000000", "run/000005"]


def test_without_poses_frames_are_taken_by_time(tmp_path, ros, depth):
    def fill(writer):
        writer.camera_info(0.0)
        for i in range(20):
            writer.image(0.1 * i, depth(i))

    path = ros.write(tmp_path, fill)
    sequence = only(path, RecordingOptions())
    assert [f.name[-2:] for f in sequence.frames] == ["00", "05", "10", "15"]
    assert sequence.frames[0].pose is None
    assert sequence.parent_frame == "run"
    assert (
        "poses of 0 of 20 frames; 20 without: there are no transforms from camera" in sequence.note
    )
    assert len(only(path, RecordingOptions(keyframe_s=0)).frames) == 20


def test_odometry_with_more_messages_is_used_and_the_other_is_named(tmp_path, ros, walk, depth):
    def fill(writer):
        writer.transforms(0.0, {("base_link", "camera"): ros.camera}, "/tf_static")
        writer.camera_info(0.0)
        for i, (t, T) in enumerate(walk):
            writer.odometry(t, T, "/filtered")
            if i % 2:
                writer.odometry(t, ros.transform(9, 9, 9), "/wheels")
            writer.image(t, depth(i))

    sequence = only(ros.write(tmp_path, fill))
    ignored = "/wheels is ignored, because the poses of base_link are from /filtered"
    assert ignored in sequence.note
    for (_, T), frame in zip(walk, sequence.frames, strict=True):
        np.testing.assert_allclose(frame.pose, T @ ros.camera, atol=1e-9)


def test_transforms_come_before_odometry_of_the_same_frames(tmp_path, ros, walk, depth):
    """Wheels slip: what a filter makes of their odometry is in tf."""

    results = []
    for name in ("with", "without"):

        def put(writer, i, t, name=name):
            if name == "with":
                writer.odometry(t + 0.03, ros.transform(9, 9, 9))
            writer.image(t + 0.03, depth(i))

        path = ros.write(tmp_path / name, partial(drive, ros=ros, walk=walk, put=put))
        results.append([frame.pose for frame in only(path).frames])
    assert len(results[0]) == len(walk) - 1  # the last lies 30 ms after the last transform
    np.testing.assert_array_equal(results[0], results[1])


@pytest.mark.parametrize("container", ["mcap", "sqlite3", "ros1"])
def test_the_stamp_counts_and_not_the_time_of_recording(container, tmp_path, ros, walk, depth):
    """Images are recorded 0.35 s late, as by slow drivers."""

    def put(writer, i, t):
        writer.late = 0.35
        writer.image(t, depth(i))
        writer.late = 0.0

    def fill(writer):
        drive(writer, ros, walk[:3], put)

    frames = only(ros.write(tmp_path, fill, container)).frames
    assert [round(frame.timestamp - ros.start, 6) for frame in frames] == [0.0, 0.1, 0.2]
    for (_, T), frame in zip(walk, frames, strict=False):
        np.testing.assert_allclose(frame.pose, T @ ros.camera, atol=1e-9)


def test_frames_without_a_stamp_get_the_time_of_recording_and_a_note(tmp_path, ros, depth):
    def fill(writer):
        writer.camera_info(0.0)
        writer.late = ros.start
        writer.image(-ros.start, depth(0))  # the stamp is 0

    sequence = only(ros.write(tmp_path, fill))
    assert [frame.timestamp for frame in sequence.frames] == [ros.start]
    assert "1 frames have no time stamp, and get the time of recording" in sequence.note


def test_a_map_comes_before_odometry_and_either_can_be_chosen(tmp_path, ros, walk, depth):
    T_map_odom = ros.transform(5, 6, 0, 0, 0, 1, 1)

    def put(writer, i, t):
        writer.image(t, depth(i))
        writer.transforms(t, {("/map", "/odom"): T_map_odom})  # ROS 1 wrote the slash

    path = ros.write(tmp_path, lambda writer: drive(writer, ros, walk, put), "ros1")
    in_map = only(path)
    assert in_map.parent_frame == "run/map"
    expected = walk[4][1] @ ros.camera
    np.testing.assert_allclose(in_map.frames[4].pose, T_map_odom @ expected, atol=1e-9)
    in_odom = only(path, RecordingOptions(pose_frame="odom", keyframe_m=0))
    np.testing.assert_allclose(in_odom.frames[4].pose, expected, atol=1e-9)
    with pytest.raises(DatasetError, match=r"from camera to 'mars'.*base_link, odom, map"):
        only(path, RecordingOptions(pose_frame="mars"))


def test_fixed_joints_that_are_published_again_and_again(tmp_path, ros, walk, depth):
    """As by robot_state_publisher of ROS 1, seldom and at other times than the frames."""

    def fill(writer):
        writer.camera_info(0.0)
        for i, (t, T) in enumerate(walk):
            if i in (0, 10):
                writer.transforms(t, {("base_footprint", "camera"): ros.camera})
            writer.transforms(t, {("odom", "base_footprint"): T})
            writer.image(t, depth(i))

    frames = only(ros.write(tmp_path, fill, "ros1")).frames
    assert len(frames) == len(walk)
    np.testing.assert_allclose(frames[20].pose, walk[20][1] @ ros.camera, atol=1e-9)
    assert frames[20].base.base_frame == "base_footprint"


def test_up_of_an_imu_at_rest(tmp_path, ros, depth):
    """The IMU hangs upside down beside the camera; the robot stands, and drives off after 3 s."""
    T_base_imu = ros.transform(0, 0.1, 0.2, 1, 0, 0, 0)  # half a turn about x
    rng = np.random.default_rng(1)

    def fill(writer):
        writer.camera_info(0.0)
        fixed = {("base_link", "camera"): ros.camera, ("base_link", "imu"): T_base_imu}
        writer.transforms(0.0, fixed, "/tf_static")
        for i in range(600):
            t = 0.01 * i
            shake = rng.normal(0, 0.03, 3) if t < 3 else rng.normal(0, 1.5, 3)
            writer.imu(t, shake - (0, 0, 9.81))
            if i % 100 == 50:
                writer.image(t, depth(i))

    frames = only(ros.write(tmp_path, fill), RecordingOptions(keyframe_s=0)).frames
    ups = [frame.camera.up if frame.camera else None for frame in frames]
    expected = ros.camera[:3, :3].T @ (0, 0, 1)
    for up in ups[:2]:
        np.testing.assert_allclose(up, expected, atol=2e-3)
    assert ups[3:] == [None] * 3
    assert meta_of(frames[0]).up is not None


# Cameras.


def one_image(ros, folder, topic="/camera/depth/image_raw", **info):
    samples = np.full((60, 80), 2000, np.uint16)

    def fill(writer):
        writer.camera_info(0.0, topic.rpartition("/")[0] + "/camera_info", **info)
        writer.image(0.1, samples, topic=topic)

    return ros.write(folder, fill)


@pytest.mark.parametrize(
    ("d", "model", "expected"),
    [
        ((), "plumb_bob", ()),
        ((0.1, -0.2, 0.001, 0.002, 0.03), "plumb_bob", (0.1, -0.2, 0.001, 0.002, 0.03)),
        ((0.1, 0.2, 0, 0, 0.3, 0, 0, 0), "rational_polynomial", (0.1, 0.2, 0, 0, 0.3)),
        ((1, 2, 0, 0, 3, 4, 0, 5, 0, 0, 0, 0), "rational_polynomial", (1, 2, 0, 0, 3, 4, 0, 5)),
        ((0, 0, 0, 0), "none", ()),
    ],
)
def test_lenses(d, model, expected, tmp_path, ros):
    (frame,) = only(one_image(ros, tmp_path, d=d, model=model)).frames
    assert frame.camera.intrinsics.distortion == expected
    assert frame.read().intrinsics.distortion == ()  # undistorted


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"d": (0.1, *[0] * 10, 0.2), "model": "rational_polynomial"}, "thin prisms"),
        ({"d": (0.1, 0.2, 0.3, 0.4), "model": "equidistant"}, "'equidistant' with 4"),
        ({"d": (0, 0, 0, 0), "model": "Kannala_Brandt4"}, "'Kannala_Brandt4' with 4"),
        ({"binning": 2}, "binning of 2"),
        ({"k": (70.0, 71.0, float("nan"), 29.5)}, "principal point"),
    ],
)
def test_lenses_that_are_not_supported(more, message, tmp_path, ros):
    with pytest.raises(InvalidIntrinsics, match=message) as caught:
        only(one_image(ros, tmp_path, **more))
    assert "run.mcap, /camera/depth/camera_info: " in str(caught.value)


def test_rectified_images_have_the_camera_of_the_projection(tmp_path, ros):
    camera = {"d": (0.1, 0.2, 0, 0, 0), "p": (65.0, 66.0, 38.0, 28.0)}
    (frame,) = only(one_image(ros, tmp_path, "/camera/depth/image_rect", **camera)).frames
    k = frame.camera.intrinsics
    assert (k.fx, k.fy, k.cx, k.cy, k.distortion) == (65, 66, 38, 28, ())


def test_a_part_of_the_image(tmp_path, ros):
    roi = {"x_offset": 10, "y_offset": 20, "width": 80, "height": 60}
    (frame,) = only(one_image(ros, tmp_path, size=(640, 480), **roi)).frames
    k = frame.camera.intrinsics
    assert (k.width, k.height, k.cx, k.cy) == (80, 60, 29.5, 9.5)
    assert frame.read().depth.shape == (60, 80)


def test_a_camera_that_is_nowhere(tmp_path, ros, depth):
    path = ros.write(tmp_path, lambda writer: writer.image(0.0, depth(0)))
    with pytest.raises(DatasetError, match=r"image_raw is unknown.*--camera-info"):
        only(path)
    (tmp_path / "intrinsics.json").write_text(
        '{"width": 80, "height": 60, "fx": 70, "fy": 70, "cx": 40, "cy": 30}'
    )
    assert len(only(path).frames) == 1


def test_an_uncalibrated_camera(tmp_path, ros):
    with pytest.raises(DatasetError, match="is not calibrated"):
        only(one_image(ros, tmp_path, k=(0.0, 0.0, 0.0, 0.0)))


def test_a_camera_of_another_size(tmp_path, ros):
    (frame,) = only(one_image(ros, tmp_path, size=(640, 480))).frames
    reason = "80 x 60 pixels, but the intrinsics are for 640 x 480"
    with pytest.raises(InvalidIntrinsics, match=reason):
        frame.read()


# Topics.


def test_images_that_are_no_depth_by_name_must_be_named(tmp_path, ros, depth):
    confidence = "/zed/confidence/confidence_map"

    def fill(writer):
        writer.camera_info(0.0)
        writer.image(0.0, depth(0), topic=confidence)
        writer.image(0.0, depth(0), topic="/ir/image_raw")
        writer.image(0.0, depth(0), topic="/camera/depth/infra")

    path = ros.write(tmp_path, fill)
    with pytest.raises(DatasetError, match=r"no topic .*confidence_map \('16UC1'\).*--topic"):
        only(path)
    outline = bag_outline(path, RecordingOptions())
    assert {outline.use_of(frame.topic) for frame in outline.frames} == {"not depth by its name"}
    camera = RecordingOptions(topic=confidence, camera_info="/camera/depth/camera_info")
    assert len(only(path, camera).frames) == 1

    def fill_both(writer):
        fill(writer)
        writer.image(0.0, depth(0), topic="/ir_camera/depth/image_raw")

    both = ros.write(tmp_path / "both", fill_both)
    sequence = only(both, RecordingOptions(camera_info="/camera/depth/camera_info"))
    assert "1 of 1 frames of /ir_camera/depth/image_raw used" in sequence.note


def test_several_topics_are_listed(tmp_path, ros, depth):
    rows = np.zeros(20, [("x", "<f4"), ("y", "<f4"), ("z", "<f4")])
    rows["x"] = np.arange(20) + 1

    def fill(writer):
        writer.camera_info(0.0)
        writer.image(0.0, np.zeros((2, 6)), "rgb8", "/camera/color/image_raw")
        writer.image(0.1, depth(0))
        writer.compressed(0.1, depth(0))
        writer.points(0.1, rows)
        writer.imu(0.1, (0, 0, 9.8))

    path = ros.write(tmp_path, fill)
    assert only(path, RecordingOptions(topic="/points")).frames[0].kind == "cloud"
    compressed = "/camera/depth/image_raw/compressedDepth"
    assert only(path, RecordingOptions(topic=compressed)).frames[0].kind == "depth"
    for options, message in (
        ({}, "2 topics have frames: /camera/depth/image_raw .*, /points .*--topic"),
        ({"topic": "/nothing"}, "There is no topic '/nothing'"),
        ({"topic": "/imu"}, r"/imu .sensor_msgs/msg/Imu, 1 messages. has no depth"),
        ({"topic": "/camera/color/image_raw"}, r"/camera/color/image_raw .* has no depth"),
        ({"topic": compressed, "camera_info": "/points"}, "no topic '/points' of CameraInfo"),
    ):
        with pytest.raises(DatasetError, match=message):
            only(path, RecordingOptions(**options))
    outline = bag_outline(path, RecordingOptions())
    assert [frame.topic.name for frame in outline.frames] == ["/camera/depth/image_raw", "/points"]
    uses = {topic.name: outline.use_of(topic) for topic in outline.topics}
    assert (uses["/imu"], uses["/camera/color/image_raw"]) == ("up", "no depth by its encoding")
    assert "--topic" in outline.problem
    assert outline.sequences == ()


def test_a_camera_elsewhere_is_found_by_its_frame(tmp_path, ros, depth):
    def fill(writer):
        writer.camera_info(0.0, "/a/info", frame="color", k=(1.0, 1.0, 1.0, 1.0))
        writer.camera_info(0.0, "/b/info", frame="camera")
        writer.image(0.0, depth(0))

    (frame,) = only(ros.write(tmp_path, fill)).frames
    assert frame.camera.intrinsics.fx == 70.0


# References.


def test_one_image_of_another_encoding_costs_no_other(tmp_path, ros, depth):
    def fill(writer):
        writer.camera_info(0.0)
        writer.image(0.0, depth(0))
        writer.image(1.0, np.zeros((2, 6)), "rgb8")
        writer.image(2.0, depth(2))

    first, second, third = only(ros.write(tmp_path, fill)).frames
    with pytest.raises(UnreadableFrame, match=r"run\.mcap, /camera/depth/image_raw at .* 'rgb8'"):
        second.read()
    assert first.read().depth.any()
    assert third.read().depth.any()


@pytest.mark.parametrize(
    ("name", "remedy"),
    [
        ("run.bag.active", "was not closed. Run `rosbag reindex`"),
        ("run.bag.orig.active", "was not closed. Run `rosbag reindex`"),
        ("run.mcap.gz", "is compressed. Run `gunzip`"),
        ("run.db3.zstd", "is compressed. Run `unzstd`"),
    ],
)  # fmt: skip
def test_unfinished_and_compressed_recordings_are_refused_with_the_remedy(name, remedy, tmp_path):
    (tmp_path / name).write_bytes(b"#ROSBAG V2.0\n")
    for path in (tmp_path, tmp_path / name):
        with pytest.raises(DatasetError, match=remedy):
            find_sequences(path)
