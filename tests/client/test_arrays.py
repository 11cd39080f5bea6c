"""Tests of frames as arrays with a camera, of path strings, and of poses in ROS notation."""

import io

import numpy as np
import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.errors import InvalidIntrinsics, InvalidRequest, UnreadableCloud, UnreadableFrame
from sceneprint_client import Client
from sceneprint_client.api import CameraIntrinsics, FrameMeta, GivenPose, Prior
from sceneprint_client.api.base import checked
from sceneprint_client.frame_files import array_sendable, camera_of, sendable

QUARTER = 0.5**0.5
CAMERA = CameraIntrinsics(width=4, height=3, fx=5, fy=6, cx=1.5, cy=1)


def loaded(data):
    return np.load(io.BytesIO(data), allow_pickle=False)


@pytest.mark.parametrize(
    "camera",
    [
        CAMERA,
        (5, 6, 1.5, 1),
        np.array([5, 6, 1.5, 1]),
        np.array([[5, 0, 1.5], [0, 6, 1], [0, 0, 1]]),
        FrameMeta(intrinsics=CAMERA),
    ],
)
def test_an_array_with_its_camera_is_depth(camera):
    millimetres = np.arange(12, dtype=np.uint16).reshape(3, 4)
    data, meta = sendable(millimetres, camera, with_pose=False, up=(0, -1, 0))
    np.testing.assert_array_equal(loaded(data), millimetres)
    assert loaded(data).dtype == np.uint16
    assert meta.intrinsics == CAMERA
    assert meta.up.unit == [0, -1, 0]
    metres = millimetres.T.astype(np.float64).T / 1000  # in Fortran's order
    data, _ = sendable(metres, camera, with_pose=False)
    assert loaded(data).dtype == np.float32  # float64 would take twice the bytes, for nothing
    np.testing.assert_allclose(loaded(data), metres, rtol=1e-6)


def test_an_array_without_a_camera_is_points():
    points = np.arange(12, dtype=np.float32).reshape(4, 3)
    data, meta = sendable(points, None, with_pose=False)
    np.testing.assert_array_equal(loaded(data), points)
    assert meta == FrameMeta()
    assert sendable(points, FrameMeta(robot="r"), with_pose=False)[1].robot == "r"


def test_points_of_a_map_keep_their_precision():
    points = np.random.default_rng(2).uniform(-20, 20, (40, 3))
    data, _ = sendable(points, None, with_pose=False)
    assert loaded(data).dtype == np.float32  # to a hundredth of a millimetre
    far = points + np.array([512_345.25, 5_412_345.5, 210.0])
    data, _ = sendable(far, None, with_pose=False)
    np.testing.assert_array_equal(loaded(data), far)


@pytest.mark.parametrize(
    ("array", "camera", "error", "message"),
    [
        (np.zeros((3, 4), np.int32), CAMERA, UnreadableFrame, "int32. Convert it to depth"),
        (np.zeros((3, 4, 1), np.uint16), CAMERA, UnreadableFrame, r"shape \(3, 4, 1\)"),
        (np.zeros((0, 4), np.uint16), CAMERA, UnreadableFrame, r"shape \(0, 4\)"),
        (np.zeros((3, 5), np.uint16), None, UnreadableFrame, "pass its camera"),
        (np.zeros((3, 3), np.uint16), None, UnreadableCloud, "uint16. Convert it to points"),
        (np.zeros(3), None, UnreadableCloud, r"shape \(3,\)"),
        (np.zeros((3, 4)), (5, 6, 1.5), InvalidIntrinsics, "camera is invalid"),
        (np.zeros((3, 4)), (5, 0, 1.5, 1), InvalidIntrinsics, "camera is invalid"),
        (np.zeros((3, 4)), np.diag([5, 6, 2]), InvalidIntrinsics, "camera is invalid"),
        (np.zeros((3, 4)), "camera", InvalidIntrinsics, "camera is invalid"),
    ],
)
def test_other_arrays_are_refused(array, camera, error, message):
    with pytest.raises(error, match=message):
        sendable(array, camera, with_pose=False)


def test_what_is_no_frame_is_refused(references):
    wrong = [[1, 2], [3, 4]]
    with pytest.raises(TypeError, match="not list"):
        sendable(wrong, CAMERA, with_pose=False)
    with pytest.raises(TypeError, match="lacks the image size"):
        sendable(references[0].path, (5, 6, 1.5, 1), with_pose=False)
    fields = {"robot": "a"}
    for frame in (references[0].path, references[0], b"P5"):
        with pytest.raises(TypeError) as caught:
            sendable(frame, fields, with_pose=False)
        assert str(caught.value) == "pass a FrameMeta or CameraIntrinsics as meta, not dict"


def test_a_path_string_and_arrays_are_one_frame(client, map_name, references, room_frames):
    client.create_map(map_name, "arrays")
    added = client.upload(map_name, str(references[0].path), wait_s=PATIENCE_S)
    assert added.state == "indexed"
    seen = room_frames[0]
    K = np.array([[seen.intrinsics.fx, 0, seen.intrinsics.cx],
                  [0, seen.intrinsics.fy, seen.intrinsics.cy], [0, 0, 1]])  # fmt: skip
    units = np.round(seen.depth * 1000).astype(np.uint16)
    meta = FrameMeta(intrinsics=client.frame(map_name, added.frame_id).intrinsics)
    by_array = client.localize(map_name, units, K)
    by_path = client.localize(map_name, str(references[0].path), meta)
    assert by_array.best.frame_id == added.frame_id
    assert by_array.best.distance == by_path.best.distance == 0
    metres = client.localize(map_name, units / 1000.0, K)
    assert metres.best.distance < 100
    compared = client.similarity(units, str(references[0].path), K)
    assert compared.similarity == 1.0


def test_the_pose_of_the_base_is_stored_as_that_of_the_sensor(client, map_name, room_frames):
    """The base stands at (1, 2, 0), turned by 90 degrees; the camera sits 0.2 m ahead, 0.5 m up."""
    k = room_frames[0].intrinsics
    camera = camera_of((k.fx, k.fy, k.cx, k.cy), (k.width, k.height))
    turn = {"x": 0, "y": 0, "z": QUARTER, "w": QUARTER}
    still = {"x": 0, "y": 0, "z": 0, "w": 1}
    record = {
        "intrinsics": camera.model_dump(),
        "pose": {"position": {"x": 1, "y": 2, "z": 0}, "orientation": turn, "of": "base",
                 "parent_frame": "odom"},
        "T_base_sensor": {"translation": {"x": 0.2, "y": 0, "z": 0.5}, "rotation": still},
    }  # fmt: skip
    client.create_map(map_name, "base")
    meta = FrameMeta.model_validate(record)
    added = client.upload(map_name, room_frames[0].depth, meta, wait_s=PATIENCE_S)
    pose = client.frame(map_name, added.frame_id).pose
    np.testing.assert_allclose(np.array(pose.matrix)[:3, 3], [1, 2.2, 0.5], atol=1e-12)
    with pytest.raises(InvalidRequest, match="requires T_base_sensor"):
        checked(FrameMeta, "The frame", **{**record, "T_base_sensor": None})
    with pytest.raises(InvalidRequest, match="pose of the sensor"):
        checked(Prior, "The prior", pose=record["pose"])
    with pytest.raises(InvalidRequest, match="the pose of the base"):
        client.edit_frame(map_name, added.frame_id, {"pose": {"of": "base"}})


def test_poses_as_ros_names_them():
    record = {"position": {"x": 1, "y": 2, "z": 3},
            "orientation": {"x": 0, "y": 0, "z": QUARTER, "w": QUARTER}}  # fmt: skip
    pose = GivenPose.model_validate({**record, "parent_frame": "map"})
    assert (pose.translation.y, pose.rotation.w) == (2, QUARTER)
    fields = pose.model_dump(exclude_defaults=True)
    assert set(fields) == {"translation", "rotation", "parent_frame"}
    for twice in ({**record, "translation": record["position"]}, {"position": record["position"]}):
        with pytest.raises(InvalidRequest):
            checked(GivenPose, "The pose", **twice)


def test_images_and_cameras_of_libraries_are_taken():
    image, o3d = pytest.importorskip("PIL.Image"), pytest.importorskip("open3d")
    millimetres = np.arange(12, dtype=np.uint16).reshape(3, 4)
    lens = o3d.camera.PinholeCameraIntrinsic(4, 3, 5.0, 6.0, 1.5, 1.0)
    for frame in (
        image.fromarray(millimetres),
        image.fromarray(millimetres.astype(np.int32)),
        image.fromarray(millimetres.astype(">u2")),
        o3d.geometry.Image(millimetres),
        o3d.t.geometry.Image(millimetres),
    ):
        data, meta = sendable(frame, lens, with_pose=False)
        np.testing.assert_array_equal(loaded(data), millimetres)
        assert loaded(data).dtype == np.uint16
        assert meta.intrinsics == CAMERA
    metres = o3d.geometry.Image((millimetres / 1000).astype(np.float32))
    data, _ = sendable(metres, lens, with_pose=False)
    np.testing.assert_allclose(loaded(data), millimetres / 1000, rtol=1e-6)
    assert sendable(b"\x89PNG", lens, with_pose=False)[1].intrinsics == CAMERA


def test_unknown_options_are_refused_before_the_frame_is_looked_at():
    with (
        Client("http://127.0.0.1:9") as client,
        pytest.raises(TypeError, match="no option camera; its options are candidates"),
    ):
        client.localize("hall", np.zeros((3, 4), np.uint16), camera=CAMERA)


def test_masked_samples_are_missing():
    camera = (300.0, 300.0, 2.0, 1.0)
    samples = np.arange(1, 13, dtype=np.uint16).reshape(3, 4)
    for masked, missing in (
        (np.ma.masked_equal(samples, 5), 0),
        (np.ma.masked_equal(samples / 8, 0.625), np.nan),
    ):
        sent = np.load(io.BytesIO(array_sendable(masked, camera)[0]))
        expected = np.array(masked.data)
        expected[1, 0] = missing
        np.testing.assert_array_equal(sent, expected)
