"""Tests of sequences of points: their files, layout and poses."""

import io
import json
import zipfile

import numpy as np
import pytest

from sceneprint.errors import DatasetError, UnreadableCloud
from sceneprint.formats.archive import open_archive
from sceneprint.formats.dataset import (
    CloudSource,
    Layout,
    find_cloud_source,
    find_sequences,
    write_depth_png,
    write_pose,
)
from sceneprint.formats.export import write_ply
from sceneprint.types import Cloud
from sceneprint_client.frame_files import meta_of
from tests.datasets.shared import pose_at

POINTS = np.arange(36, dtype=np.float32).reshape(12, 3) / 8


def kitti(points):
    return np.concatenate([points, np.zeros((len(points), 1))], axis=1).astype("<f4").tobytes()


def points_of(frame):
    cloud = frame.read()
    assert isinstance(cloud, Cloud)
    assert cloud.name == frame.name
    return cloud.points


@pytest.fixture
def hall(tmp_path):
    folder = tmp_path / "hall"
    folder.mkdir()
    for i in (2, 10, 1):
        (folder / f"scan-{i}.ply").write_bytes(write_ply(POINTS + i))
    (folder / "scan-3.BIN").write_bytes(kitti(POINTS + 3))
    write_pose(folder / "scan-2.pose.txt", pose_at(2.0))
    (folder / "notes.txt").write_text("nothing")
    return folder


def test_a_folder_of_clouds(hall):
    (sequence,) = find_sequences(hall)
    assert (sequence.layout, sequence.name, sequence.parent_frame) == (
        Layout.CLOUDS,
        "hall",
        "hall",
    )
    names = [frame.name for frame in sequence.frames]
    assert names == ["hall/scan-1", "hall/scan-2", "hall/scan-3", "hall/scan-10"]
    for frame, i in zip(sequence.frames, (1, 2, 3, 10), strict=True):
        assert (frame.kind, frame.camera) == ("cloud", None)
        np.testing.assert_array_equal(points_of(frame), POINTS + i)
    assert [frame.pose is not None for frame in sequence.frames] == [False, True, False, False]
    np.testing.assert_array_equal(sequence.frames[1].read().pose, pose_at(2.0))
    with pytest.raises(DatasetError, match="This is a cloud, not a depth image"):
        sequence.frames[0].read_depth()


def test_one_cloud(hall):
    (sequence,) = find_sequences(hall / "scan-2.ply")
    assert [frame.name for frame in sequence.frames] == ["hall/scan-2"]
    np.testing.assert_array_equal(sequence.frames[0].pose, pose_at(2.0))
    np.save(hall / "points.npy", POINTS)
    np.save(hall / "image.npy", np.ones((12, 16), np.float32))
    (frame,) = find_sequences(hall / "points.npy")[0].frames
    np.testing.assert_array_equal(points_of(frame), POINTS)
    with pytest.raises(DatasetError, match=r"no intrinsics\.json"):
        find_sequences(hall / "image.npy")


def test_what_clouds_json_says(hall):
    said = {"viewpoint": {"x": 1, "y": 0, "z": -2.5}, "units_per_metre": 1000}
    (hall / "clouds.json").write_text(json.dumps(said))
    np.save(hall / "scan-4.npy", POINTS)  # of points, beside clouds.json
    frames = find_sequences(hall)[0].frames
    assert len(frames) == 5
    assert frames[0].cloud == CloudSource(None, (1.0, 0.0, -2.5), 1000.0)
    np.testing.assert_allclose(
        points_of(frames[0]), (POINTS + 1.0) / 1000 - (1.0, 0.0, -2.5), atol=1e-6
    )
    (hall / "clouds.json").write_text('{"up": [0, 0.6, 0.8]}')
    assert find_cloud_source(hall) == CloudSource(up=(0.0, 0.6, 0.8))
    (hall / "clouds.json").write_text('{"viewpoint": null, "format": "kitti"}')
    assert find_cloud_source(hall) == CloudSource("kitti", None, 1.0)
    inner = hall / "a" / "b"
    inner.mkdir(parents=True)
    assert find_cloud_source(inner) == find_cloud_source(hall)
    with pytest.raises(UnreadableCloud, match=r"scan-1\.ply: This is not a KITTI scan"):
        find_sequences(hall)[0].frames[0].read()


def test_rows_that_clouds_json_names(tmp_path):
    rows = np.c_[np.arange(12), POINTS[:, ::-1], np.ones(12)].astype("<f4")
    folder = tmp_path / "drive"
    folder.mkdir()
    (folder / "0.bin").write_bytes(rows.tobytes())
    (folder / "1.ply").write_bytes(write_ply(POINTS))
    (folder / "clouds.json").write_text('{"row": "range, z, y, X, i", "units_per_metre": 100}')
    first, second = find_sequences(folder)[0].frames
    np.testing.assert_allclose(points_of(first), POINTS / 100, rtol=1e-6)
    np.testing.assert_allclose(points_of(second), POINTS / 100, rtol=1e-6)
    assert meta_of(first).format is None  # what is sent is NPY
    np.testing.assert_array_equal(np.load(io.BytesIO(first.read_bytes())), POINTS)
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as file:
        for path in folder.iterdir():
            file.write(path, f"drive/{path.name}")
    with open_archive(packed, tmp_path) as archive:
        ((path, _),) = (sequence.frames for sequence in archive.sequences)
        assert archive.data_of(path) == first.read_bytes()
    (folder / "0.bin").write_bytes(rows.tobytes()[:-4])
    with pytest.raises(
        UnreadableCloud, match=r"0\.bin: The file has 236 bytes, which is not a multiple of 20"
    ):
        points_of(first)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"row": "x,y,i"}', "must name x, y and z once each"),
        ('{"row": "x,y,z,x"}', "must name x, y and z once each"),
        ('{"row": "x,y,z", "format": "npy"}', "only for .bin files, but format is npy"),
        ("{", "not JSON"),
        ('{"format": "stl"}', "format is 'stl'"),
        ('{"units_per_metre": 0}', "units_per_metre is 0"),
        (f'{{"units_per_metre": 1{400 * "0"}}}', "units_per_metre is 1000"),
        ('{"viewpoint": [0, 0, 1]}', r"viewpoint is \[0, 0, 1\]"),
        ('{"viewpoint": {"x": 0, "y": 0, "z": 1e999}}', "z is inf"),
    ],
)
def test_clouds_json_that_is_none(hall, text, message):
    (hall / "clouds.json").write_text(text)
    with pytest.raises(DatasetError, match=rf"clouds\.json: .*{message}"):
        find_sequences(hall)


def test_depth_and_clouds_together(hall, tmp_path):
    """Images win, as a mesh often lies beside them, unless clouds.json is there."""
    write_depth_png(hall / "scan-1.png", np.ones((3, 4), np.float32), 1000.0)
    with pytest.raises(DatasetError, match=r"no intrinsics\.json"):
        find_sequences(hall)
    (hall / "clouds.json").write_text("{}")
    assert len(find_sequences(hall)[0].frames) == 4

    scene = tmp_path / "scene"
    (scene / "depth").mkdir(parents=True)
    (scene / "mesh.ply").write_bytes(write_ply(POINTS))
    (scene / "depth" / "0.pcd").write_bytes(b"")
    assert [s.name for s in find_sequences(scene)] == ["depth"]


def test_a_mesh_does_not_hide_the_images_below_it(hall):
    for run, deeper in (("a", ""), ("b", "night")):
        folder = hall / run / deeper
        folder.mkdir(parents=True)
        write_depth_png(folder / "0.png", np.ones((3, 4), np.float32), 1000.0)
    # pictures without a camera are no depth, and clouds may lie above them
    assert [s.layout for s in find_sequences(hall)] == [Layout.CLOUDS]
    camera = {"width": 4, "height": 3, "fx": 4, "fy": 4, "cx": 2, "cy": 1}
    (hall / "b" / "intrinsics.json").write_text(json.dumps(camera))
    (hall / "a" / "0.png").unlink()
    assert [(s.name, s.layout) for s in find_sequences(hall)] == [("b/night", Layout.PLAIN)]
    (hall / "clouds.json").write_text("{}")
    assert [s.layout for s in find_sequences(hall)] == [Layout.CLOUDS]


def test_files_that_are_neither_depth_nor_points_are_named_as_such(tmp_path):
    (tmp_path / "points.csv").write_text("x,y,z\n1,2,3\n")
    with pytest.raises(DatasetError, match=r"points\.csv: The file is neither a depth image \("):
        find_sequences(tmp_path / "points.csv")
    np.save(tmp_path / "points.npy", np.ones((3, 500), np.float32))
    with pytest.raises(DatasetError, match=r"no intrinsics\.json.*must be \(N, 3\) or \(N, 4\)"):
        find_sequences(tmp_path / "points.npy")
