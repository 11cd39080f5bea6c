"""Tests that written folders are recognised, and that invalid folders raise errors."""

import numpy as np
import pytest

from sceneprint.errors import DatasetError, InvalidIntrinsics, InvalidPose, UnreadableFrame
from sceneprint.formats.dataset import (
    Camera,
    Layout,
    find_sequences,
    sequences,
    write_depth_png,
    write_intrinsics,
)
from sceneprint.formats.dataset.frame_reference import numbered_sequences
from sceneprint.types import Intrinsics
from tests.datasets.shared import CAMERA, DEPTH, pose_at, seven_scenes


@pytest.fixture
def kitchen(tmp_path):
    scene = tmp_path / "kitchen"
    for number in (1, 2, 10):
        seven_scenes(scene / f"seq-{number:02d}")
    (scene / "TrainSplit.txt").write_text("sequence1\r\nsequence 10\r\n")
    (scene / "TestSplit.txt").write_text("sequence2\n")
    (scene / "kitchen.png").write_bytes(b"a picture of the scene")
    write_intrinsics(scene, CAMERA)
    return scene


def test_a_scene(kitchen):
    runs = find_sequences(kitchen)
    assert [s.name for s in runs] == ["seq-01", "seq-02", "seq-10"]
    assert [s.split for s in runs] == ["train", "test", "train"]
    assert {s.layout for s in runs} == {Layout.SEVEN_SCENES}
    assert {s.parent_frame for s in runs} == {"kitchen"}
    assert runs[1].folder == kitchen / "seq-02"
    assert [f.name for f in runs[1].frames] == ["seq-02/frame-000000", "seq-02/frame-000001"]
    frame = runs[1].frames[1].read()
    np.testing.assert_array_equal(frame.depth, DEPTH + 1)
    np.testing.assert_array_equal(frame.pose, pose_at(1))
    assert frame.name == "seq-02/frame-000001"
    assert runs[1].frames[1].timestamp is None


def test_a_camera_that_is_given_stands_in_for_a_missing_one_alone(kitchen):
    values = Camera(Intrinsics(8, 6, 7.0, 7.0, 4.0, 3.0))
    assert {f.camera for s in find_sequences(kitchen, camera=values) for f in s.frames} == {CAMERA}
    (kitchen / "intrinsics.json").unlink()
    assert {f.camera for s in find_sequences(kitchen, camera=values) for f in s.frames} == {values}
    (kitchen / "intrinsics.json").write_text("{}")
    with pytest.raises(InvalidIntrinsics):
        find_sequences(kitchen, camera=values)


def test_a_pose_is_read_when_asked_for(kitchen):
    (kitchen / "seq-01/frame-000000.pose.txt").unlink()
    (kitchen / "seq-01/frame-000001.pose.txt").write_text("nan " * 16)
    first, second = find_sequences(kitchen / "seq-01")[0].frames
    assert first.pose is None
    assert first.read().pose is None
    for read in (second.read, lambda: second.pose):
        with pytest.raises(InvalidPose, match=r"frame-000001\.pose\.txt: .*not finite"):
            read()


def test_a_single_file(kitchen):
    (sequence,) = find_sequences(kitchen / "seq-02/frame-000001.depth.png")
    assert (sequence.name, sequence.parent_frame, sequence.split) == ("seq-02", "kitchen", "test")
    (reference,) = sequence.frames
    assert reference.name == "seq-02/frame-000001"
    np.testing.assert_array_equal(reference.read().pose, pose_at(1))

    np.save(kitchen / "rgbd.npy", DEPTH)
    (sequence,) = find_sequences(kitchen / "rgbd.npy")
    assert (sequence.layout, sequence.frames[0].name) == (Layout.PLAIN, "kitchen/rgbd")
    np.testing.assert_array_equal(sequence.frames[0].read().depth, DEPTH)
    (sequence,) = find_sequences(kitchen / "TrainSplit.txt")
    with pytest.raises(UnreadableFrame, match=r"^.*TrainSplit\.txt: "):
        sequence.frames[0].read()


def test_nothing_there(tmp_path):
    with pytest.raises(DatasetError, match=r"absent: The file or folder does not exist"):
        find_sequences(tmp_path / "absent")
    with pytest.raises(DatasetError, match=r"no depth image .*7-Scenes .*TUM .*NPY"):
        find_sequences(tmp_path)


def test_four_folders_down_and_no_further(tmp_path):
    write_intrinsics(tmp_path, CAMERA)
    seven_scenes(tmp_path / "1/2/3/4")
    seven_scenes(tmp_path / "1/2/3/x/5")
    assert [s.name for s in find_sequences(tmp_path)] == ["1/2/3/4"]


def test_symlinks_do_not_go_in_circles(kitchen):
    (kitchen / "again").symlink_to(kitchen, target_is_directory=True)
    (kitchen / "self").symlink_to(kitchen / "self")
    (kitchen / "seq-01/up").symlink_to(kitchen.parent, target_is_directory=True)
    assert len(find_sequences(kitchen)) == 3
    # but a data set on another disk is reached
    shelf = kitchen.parent / "shelf"
    shelf.mkdir()
    (shelf / "room").symlink_to(kitchen, target_is_directory=True)
    assert find_sequences(shelf)[0].name == "room/seq-01"


@pytest.mark.parametrize(
    ("train", "message"),
    [
        ("sequence1\nsequence2", "for both training and testing"),
        ("sequence1\nfirst", "line 2: The line is not a sequence"),
        ("sequence1\n\nsequence3", "line 3: The folder seq-03 does not exist"),
    ],
)
def test_bad_splits(train, message, kitchen):
    (kitchen / "TrainSplit.txt").write_text(train)
    with pytest.raises(DatasetError, match=message):
        find_sequences(kitchen)


def test_two_scenes_of_one_name(kitchen):
    seven_scenes(kitchen.parent / "old/kitchen/seq-01")
    write_intrinsics(kitchen.parent, CAMERA)
    with pytest.raises(DatasetError, match=r"has the same name kitchen"):
        find_sequences(kitchen.parent)


def test_a_whole_disk_is_not_searched(tmp_path, monkeypatch):
    for i in range(7):
        (tmp_path / str(i)).mkdir()
    monkeypatch.setattr(sequences, "_MAXIMUM_FOLDERS", 5)
    with pytest.raises(DatasetError, match="more than 5 folders"):
        find_sequences(tmp_path)


def test_frames_have_the_numbers_and_names_of_their_files(kitchen, tmp_path):
    (kitchen / "seq-01" / "frame-000000.depth.png").unlink()  # a part has the numbers of the whole
    first, second, _ = find_sequences(kitchen)
    assert [(f.original, f.sequence) for f in first.frames] == [("frame-000001.depth.png", 1)]
    assert [f.sequence for f in second.frames] == [0, 1]
    (alone,) = find_sequences(kitchen / "seq-02" / "frame-000001.depth.png")
    assert alone.frames[0].sequence == 1
    plain = tmp_path / "plain"
    plain.mkdir()
    write_intrinsics(plain, CAMERA)
    for name in ("b10.png", "b9.png", "a.png"):
        write_depth_png(plain / name, DEPTH, 1000.0)
    (sequence,) = find_sequences(plain)
    assert [(f.original, f.sequence) for f in sequence.frames] \
        == [("a.png", 0), ("b9.png", 1), ("b10.png", 2)]  # fmt: skip
    (alone,) = find_sequences(plain / "b9.png")
    assert alone.frames[0].sequence is None  # its place is not known


def test_sequences_of_one_session_are_numbered_one_after_the_other(kitchen):
    def places(found, session):
        sequences = numbered_sequences(found, session)
        return [[frame.sequence for frame in sequence.frames] for sequence in sequences]

    runs = find_sequences(kitchen)
    assert places(runs, None) == [[0, 1], [0, 1], [0, 1]]
    assert places(runs, "all") == [[0, 1], [2, 3], [4, 5]]
    # files of one folder, named one by one, keep its numbers
    files = [kitchen / f"seq-{s}/frame-00000{i}.depth.png" for s in ("02", "01") for i in (1, 0)]
    singles = [sequence for file in files for sequence in find_sequences(file)]
    assert places(singles, None) == [[1], [0], [1], [0]]
    assert places(singles, "all") == [[1], [0], [3], [2]]
    in_turns = [singles[i] for i in (1, 3, 0, 2)]
    assert places(in_turns, "all") == [[0], [2], [1], [3]]
