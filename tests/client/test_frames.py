"""Tests of the bytes and metadata of frames to send, and of interrupted jobs."""

import json
import shutil

import numpy as np
import pytest

import sceneprint
from sceneprint import errors
from sceneprint.formats.dataset import FrameReference
from sceneprint_client import Client, meta_of
from sceneprint_client.frame_files import sendable


def test_what_is_sent_of_a_data_set(references, tmp_path):
    meta = meta_of(references[4], robot="r", session="s", tags=("a", "b"), parent_frame="p")
    assert (meta.robot, meta.session, meta.tags) == ("r", "s", ["a", "b"])
    assert (meta.depth_scale, meta.depth_along_ray, meta.captured_at) == (1000.0, False, None)
    assert (meta.pose.parent_frame, meta.pose.translation) == ("p", None)
    np.testing.assert_array_equal(meta.pose.matrix, references[4].pose)
    assert meta_of(references[4], with_pose=False).pose is None
    assert meta_of(references[4]).session == "room-1/seq-01"
    with pytest.raises(errors.InvalidRequest, match="robot: must be characters of one line"):
        meta_of(references[4], robot="a\nb")
    camera = references[4].camera
    for stamp, year in ((1305031102.25, 2011), (12.5, None), (1.3e18, None)):
        reference = FrameReference("seq/x", tmp_path / "x.png", camera, stamp)
        dated = meta_of(reference).captured_at
        assert (None if dated is None else dated.year) == year


def test_a_path_is_sent_with_the_camera_beside_it(references, tmp_path):
    data, meta = sendable(references[2].path, None, with_pose=True)
    assert data == references[2].path.read_bytes()
    np.testing.assert_array_equal(meta.pose.matrix, references[2].pose)
    assert meta.intrinsics == meta_of(references[2]).intrinsics
    own_meta = meta.model_copy(update={"depth_scale": 5000.0})
    assert sendable(references[2].path, own_meta, with_pose=True) == (data, own_meta)
    bare = tmp_path / "frame.png"
    shutil.copy(references[2].path, bare)
    with pytest.raises(errors.DatasetError, match=r"intrinsics\.json"):
        sendable(bare, None, with_pose=False)
    with pytest.raises(errors.DatasetError, match="This is a folder"):
        sendable(references[2].path.parent, None, with_pose=False)
    with pytest.raises(errors.UnreadableFrame, match="cannot be read"):
        sendable(tmp_path / "absent.png", meta, with_pose=False)


def test_up_is_sent_as_given_or_as_beside_the_frame(references, tmp_path):
    assert meta_of(references[0]).up is None
    assert meta_of(references[0], up=(0, -1, 0)).up.unit == [0.0, -1.0, 0.0]
    path = tmp_path / references[0].path.name
    shutil.copy(references[0].path, path)
    beside = json.loads(references[0].path.with_name("intrinsics.json").read_text())
    (tmp_path / "intrinsics.json").write_text(json.dumps(beside | {"up": [0.6, -0.8, 0]}))
    for up, expected in ((None, [0.6, -0.8, 0.0]), ([0, 0, 1], [0.0, 0.0, 1.0])):
        _, meta = sendable(path, None, with_pose=False, up=up)
        assert meta.up.unit == pytest.approx(expected)
    data, known = path.read_bytes(), meta
    assert sendable(data, known, with_pose=False, up=[1, 0, 0])[1].up.x == 1.0
    for wrong in ([0, 0, 2], [0, 1], []):
        with pytest.raises(errors.InvalidRequest, match="The up vector"):
            sendable(data, known, with_pose=False, up=wrong)


def test_a_query_needs_no_pose(embedded, references, tmp_path):
    folder = tmp_path / "seq-01"
    shutil.copytree(references[0].path.parent, folder)
    (folder / "frame-000000.pose.txt").write_text("no pose")
    path = folder / "frame-000000.depth.png"
    embedded.create_map("m")
    answer = embedded.query("m", path)
    assert (answer.status, answer.matches, answer.counts.map) == ("not_found", [], 0)
    with pytest.raises(errors.InvalidPose, match=r"frame-000000\.pose\.txt"):
        embedded.upload("m", path)


def test_a_folder_is_all_there_is(tmp_path, monkeypatch):
    monkeypatch.setenv("SCENEPRINT_DATABASE_URL", f"sqlite:///{tmp_path}/elsewhere.db")
    monkeypatch.setenv("SCENEPRINT_INDEX_DIR", str(tmp_path / "elsewhere"))
    with sceneprint.Client.embedded(tmp_path / "here") as client:
        client.create_map("m")
    assert [path.name for path in tmp_path.iterdir()] == ["here"]
    with Client.embedded(str(tmp_path / "here")) as client:
        assert [record.name for record in client.maps()] == ["m"]
