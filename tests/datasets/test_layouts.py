"""Tests of each layout: frames, order and poses."""

import numpy as np
import pytest

from sceneprint.errors import DatasetError
from sceneprint.formats.dataset import (
    Camera,
    Layout,
    find_sequences,
    write_depth_png,
    write_intrinsics,
    write_pose,
)
from sceneprint.formats.dataset.frame_names import is_beside_depth
from sceneprint.formats.dataset.sequences import natural
from tests.datasets.shared import CAMERA, DEPTH, pose_at


def tum(folder):
    (folder / "depth").mkdir(parents=True)
    (folder / "rgb").mkdir()
    (folder / "rgb/9.0.png").write_bytes(b"colour")
    for stamp in ("9.5", "10.02", "10.5"):
        write_depth_png(folder / f"depth/{stamp}.png", DEPTH, 5000.0)
    (folder / "depth.txt").write_text(
        "# timestamp filename\n10.5 depth/10.5.png\n9.5 depth/9.5.png\n10.02 depth/10.02.png\n"
    )
    (folder / "groundtruth.txt").write_text(
        "# t tx ty tz qx qy qz qw\n10.00 1 0 0 0 0 0 1\n10.04 2 0 0 0 0 0 1\n10.9 3 0 0 0 0 0 1\n"
    )
    write_intrinsics(folder, Camera(CAMERA.intrinsics, 5000.0))
    return folder


def test_tum(tmp_path):
    (sequence,) = find_sequences(tum(tmp_path / "desk"))
    assert (sequence.layout, sequence.parent_frame) == (Layout.TUM, "desk")
    assert [f.timestamp for f in sequence.frames] == [9.5, 10.02, 10.5]
    assert [f.name for f in sequence.frames] == ["desk/9.5", "desk/10.02", "desk/10.5"]
    early, between, gap = sequence.frames
    assert early.pose is None
    assert gap.pose is None  # 0.86 s between its neighbours
    np.testing.assert_allclose(between.pose, pose_at(1.5), atol=1e-9)
    np.testing.assert_array_equal(between.read().depth, DEPTH)  # at 5000 units a metre


def test_tum_stamps_that_differ_by_rounding_or_a_millisecond(tmp_path):
    folder = tum(tmp_path / "desk")
    rows = "9.501 1 0 0 0 0 0 1\n10.019999 2 0 0 0 0 0 1\n10.9 3 0 0 0 0 0 1\n"
    (folder / "groundtruth.txt").write_text(rows)
    (sequence,) = find_sequences(folder)
    assert [None if f.pose is None else f.pose[0, 3] for f in sequence.frames] == [1, 2, None]
    assert sequence.unposed == (
        "groundtruth.txt has no pose within 20 ms of their time stamps (nearest: 0.4 s away)"
    )


def test_tum_poses_that_contradict_each_other_are_not_interpolated(tmp_path):
    folder = tum(tmp_path / "desk")
    rows = "9.49 0 0 0 0 0 0 1\n9.51 0.1 0 0 0 0 0 1\n10 0 0 0 0 0 0 1\n10.04 9 0 0 0 0 0 1\n"
    (folder / "groundtruth.txt").write_text(rows)
    (sequence,) = find_sequences(folder)
    assert [None if f.pose is None else f.pose[0, 3] for f in sequence.frames] == [0.05, None, None]
    assert sequence.unposed.endswith("or its poses contradict each other (50 m/s)")


@pytest.mark.parametrize("file", ["poses.txt", "../traj.txt", "CameraTrajectory.csv"])
def test_poses_in_a_file_that_is_not_read_are_lost(file, tmp_path):
    folder = tmp_path / "kitchen/results"
    folder.mkdir(parents=True)
    write_depth_png(folder / "0.png", DEPTH, 1000.0)
    write_intrinsics(folder, CAMERA)
    (folder / file).write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
    (sequence,) = find_sequences(folder)
    assert sequence.lost == 1
    assert sequence.unposed.endswith(f"; {file.rpartition('/')[2]} is not read")


@pytest.mark.parametrize(
    ("image", "pose"),
    [
        ("000001.png", "000001.pose.txt"),
        ("000001.depth.png", "000001.pose.txt"),
        ("depth_000001.png", "pose_000001.txt"),
        ("depth/20.png", "pose/20.txt"),  # ScanNet
        ("depth/frame_20.npy", "poses/frame_20.pose.txt"),
        ("20.npy", "poses/20.txt"),
    ],
)
def test_poses_beside_plain_images(image, pose, tmp_path):
    file = tmp_path / "scene" / image
    for name in (image, pose):
        (tmp_path / "scene" / name).parent.mkdir(parents=True, exist_ok=True)
    other = file.with_stem(file.stem + "9")
    for one in (file, other):
        if one.suffix == ".npy":
            np.save(one, DEPTH)
        else:
            write_depth_png(one, DEPTH, 1000.0)
    write_pose(tmp_path / "scene" / pose, pose_at(3.0))
    write_intrinsics(tmp_path / "scene", CAMERA)
    (sequence,) = find_sequences(tmp_path / "scene")
    poses = {frame.path.name: frame.pose for frame in sequence.frames}
    np.testing.assert_array_equal(poses[file.name], pose_at(3.0))
    assert poses[other.name] is None
    assert sequence.unposed.startswith("there is no NAME.pose.txt beside them")
    (alone,) = find_sequences(file)  # as when it is named by itself
    np.testing.assert_array_equal(alone.frames[0].pose, pose_at(3.0))


@pytest.mark.parametrize(
    ("name", "is_beside"),
    [
        ("ir", True), ("IRImages", True), ("left_ir", True), ("infra1", True), ("confidence", True),
        ("normal", True), ("disparity", True), ("disp_0", True), ("thermal", True),
        ("left_intensity", True), ("segmentation", True), ("abnormal", False), ("display", False),
        ("depthIR", True), ("depth_confidence", True), ("label-filt", True), ("rgb", True),
        ("color_aligned_to_depth", True), ("colour", True), ("x_RGB.png", True),
        ("rgb_depth_0001.png", True), ("depth", False), ("aligned_depth_to_color", False),
        ("depth_to_infra1", False), ("rgbd_depth_0001.png", False), ("stairs", False),
        ("rgbd_dataset_freiburg1_xyz", False), ("first_floor", False), ("rgb-d_0001.png", False),
        ("color_aligned_depth", False), ("depth_registered", False), ("unmasked", False),
    ],
)  # fmt: skip
def test_names_of_what_lies_beside_depth(name, *, is_beside):
    assert is_beside_depth(name) is is_beside


def test_what_is_left_out_is_named(tmp_path):
    scene = tmp_path / "scene"
    for folder in ("depth", "ir", "aligned_depth_to_color"):
        (scene / folder).mkdir(parents=True)
        write_depth_png(scene / folder / "0.png", DEPTH, 1000.0)
    write_intrinsics(scene, CAMERA)
    write_depth_png(scene / "depth" / "confidence_0.png", DEPTH, 1000.0)
    sequences = find_sequences(scene)
    assert [s.name for s in sequences] == ["aligned_depth_to_color", "depth"]
    assert [f.path.name for s in sequences for f in s.frames] == ["0.png", "0.png"]
    assert sequences[0].note.startswith("skipped: scene/ir, scene/depth/confidence_0.png (colour, ")
    assert sequences[1].note == ""
    (sequence,) = find_sequences(scene / "ir")
    assert len(sequence.frames) == 1
    for image in scene.glob("*depth*/?.png"):
        image.unlink()
    with pytest.raises(DatasetError, match=r"skipped: scene/ir, .*confidence_0\.png"):
        find_sequences(scene)


def test_folders_below_frames_are_named(tmp_path):
    scene = tmp_path / "scene"
    for place in ("", "more", "ir", "pose"):
        (scene / place).mkdir(exist_ok=True, parents=True)
        if place != "pose":
            write_depth_png(scene / place / "0.png", DEPTH, 1000.0)
    write_intrinsics(scene, CAMERA)
    (sequence,) = find_sequences(scene)
    assert [frame.name for frame in sequence.frames] == ["scene/0"]
    assert sequence.note.startswith("not read: scene/more (below")
    assert sequence.lost == 1


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("11.0 ../secret.png", "line 1: .*outside"),
        ("11.0 /etc/passwd", "line 1: .*outside"),
        ("11.0 depth/absent.png", "line 1: .*file depth/absent.png does not exist"),
        ("11.0", "line 1: .*not a time stamp and a file"),
        ("inf depth/9.5.png", "line 1: .*not finite"),
        ("# nothing", "list is empty"),
        ("1 depth/9.5.png\n2 depth/9.5.png", "same name"),
    ],
)
def test_bad_lists(line, message, tmp_path):
    folder = tum(tmp_path / "desk")
    (tmp_path / "secret.png").write_bytes(b"secret")
    (folder / "depth.txt").write_text(line + "\n")
    with pytest.raises(DatasetError, match=message):
        find_sequences(folder)


def test_a_plain_folder_in_natural_order(tmp_path):
    for name in ("d10.png", "d9.png", "d1.PNG"):
        write_depth_png(tmp_path / name, DEPTH, 1000.0)
    np.save(tmp_path / "d2.npy", DEPTH)
    for name in ("a.color.png", "rgb_1.png", "x_RGB.png", ".hidden.png", "notes.txt", "p.pose.txt"):
        (tmp_path / name).write_bytes(b"no depth")
    write_intrinsics(tmp_path, CAMERA)
    (sequence,) = find_sequences(tmp_path)
    assert sequence.layout is Layout.PLAIN
    assert [f.path.name for f in sequence.frames] == ["d1.PNG", "d2.npy", "d9.png", "d10.png"]
    assert sequence.frames[1].name == f"{tmp_path.name}/d2"
    for reference in sequence.frames:
        np.testing.assert_array_equal(reference.read().depth, DEPTH)
        assert reference.pose is None


def test_natural_order():
    names = ["a10", "a9", "a", "10", "9", "a01", "a1", "b²", "b", "a1b2", "a1b10", "9" * 5000]
    expected = ["9", "10", "9" * 5000, "a", "a01", "a1", "a1b2", "a1b10", "a9", "a10", "b", "b²"]
    assert sorted(names, key=natural) == expected


def test_a_file_of_two_kinds_has_one_name(tmp_path):
    write_intrinsics(tmp_path, CAMERA)
    np.save(tmp_path / "a.npy", DEPTH)
    write_depth_png(tmp_path / "a.png", DEPTH, 1000.0)
    with pytest.raises(DatasetError, match=r"a\.png: .*same name"):
        find_sequences(tmp_path)
