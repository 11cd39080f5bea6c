"""Tests of uploads: repetition, conflicts, deletion, point clouds, and invalid metadata."""

import io
import json
import math

import numpy as np
import pytest
from PIL import Image
from pydantic import ValidationError
from scipy.spatial.transform import Rotation
from sqlalchemy import event, update

from sceneprint.decoders import LocalDecoders
from sceneprint.engine.ingest.frame_decoder import content_id, pose_matrix, read_upload
from sceneprint.engine.maps.tombstones import Tombstones
from sceneprint.engine.serializers import transform
from sceneprint.errors import (
    FrameConflict,
    InvalidIntrinsics,
    InvalidPose,
    UnreadableCloud,
    UselessFrame,
)
from sceneprint.formats.export import write_ply
from sceneprint.store.tables import jobs
from sceneprint_client.api import FrameMeta, FrameState, GivenPose, JobState, NewMap, Query
from tests.engine.conftest import packed_again


def blobs(engine):
    return sorted(engine.store.blobs.digests())


def with_(meta, **more):
    return FrameMeta.model_validate(meta.model_dump() | more)


def test_the_same_upload_is_the_frame_that_is_there(empty, uploads):
    data, meta = uploads[0].data, uploads[0].meta
    first, new = empty.add_frame("hall", data, meta)
    assert (new, first.state, first.reason) == (True, FrameState.RECEIVED, None)
    assert empty.get_frame("hall", first.frame_id).state == FrameState.RECEIVED
    assert empty.add_frame("hall", data, meta) == (first, False)
    assert empty.add_frame("hall", packed_again(data, 0), meta) == (first, False)
    assert len(blobs(empty)) == 1  # other bytes of the same frame are not kept
    assert empty.work_off() == [JobState.SUCCEEDED]
    again, new = empty.add_frame("hall", packed_again(data, 9), meta)
    assert (again.frame_id, again.job_id, new) == (first.frame_id, first.job_id, False)
    assert again.state == FrameState.INDEXED
    assert empty.event_kinds() == ["map.created", "frame.received", "frame.indexed"]
    assert empty.statistics.state_counts() == ({"indexed": 1}, {"succeeded": 1})


def sweep_before(engine, table, digests):
    """Remove blobs, as a deletion elsewhere would, just before the first write to a table."""
    swept = list[str]()

    def sweep(_connection, _cursor, statement, *_):
        begins = "BEGIN IMMEDIATE" if engine.store.database.is_sqlite else table
        if not swept and begins in statement:
            swept.extend(digests())
            engine.store.blobs.remove(*swept)

    event.listen(engine.store.database._engine, "before_cursor_execute", sweep)


def test_an_upload_whose_bytes_are_swept_before_its_commit_is_stored_again(empty, uploads):
    sweep_before(empty, "INSERT INTO frames", lambda: blobs(empty))
    added, new = empty.add(uploads[0])
    assert new
    actual = empty.get_frame("hall", added.frame_id)
    assert empty.get_map("hall").frames == {"received": 1}
    assert [empty.store.blobs.get(blob) for blob in blobs(empty)] == [uploads[0].data]
    assert actual.state == FrameState.RECEIVED


def test_a_signature_whose_artifact_is_swept_before_its_commit_is_made_again(empty, uploads):
    added, _ = empty.add(uploads[0])
    (upload,) = blobs(empty)
    claimed = empty.claim("w")
    sweep_before(empty, "INSERT INTO signatures", lambda: [b for b in blobs(empty) if b != upload])
    if empty.store.database.is_sqlite:
        assert empty.run(claimed) == JobState.QUEUED
        assert empty.get_frame("hall", added.frame_id).state == FrameState.RECEIVED
        empty.write(update(jobs).values(run_after=0.0))
        assert empty.work_off() == [JobState.SUCCEEDED]
    else:  # it was committed with its only statement, and is put again
        assert empty.run(claimed) == JobState.SUCCEEDED
    assert empty.get_frame("hall", added.frame_id).state == FrameState.INDEXED
    assert len(blobs(empty)) == 2


def test_other_metadata_of_the_same_content_is_a_conflict_that_names_it(empty, uploads):
    data, meta = uploads[0].data, uploads[0].meta
    added, _ = empty.add_frame("hall", data, meta)
    moved = np.array(meta.pose.matrix)
    moved[0, 3] += 1e-9
    for more, fields in (
        ({"robot": "R2"}, "robot"),
        ({"session": "night"}, "session"),
        ({"tags": ["a"]}, "tags"),
        ({"captured_at": "2026-01-01T00:00:00Z"}, "captured_at"),
        ({"pose": None}, "pose.parent_frame, pose"),
        ({"pose": {"parent_frame": "x", "matrix": meta.pose.matrix}}, "pose.parent_frame"),
        ({"pose": {"parent_frame": uploads[0].room, "matrix": moved.tolist()}}, "pose"),
        ({"robot": "R2", "tags": ["a", "b"]}, "robot, tags"),
    ):
        with pytest.raises(FrameConflict) as caught:
            empty.add_frame("hall", packed_again(data, 1), with_(meta, **more))
        output = f"Frame {added.frame_id} has the same content, but a different {fields}. A map"
        assert str(caught.value).startswith(output)
    assert len(blobs(empty)) == 1
    assert empty.statistics.state_counts() == ({"received": 1}, {"queued": 1})


def test_other_samples_another_camera_and_another_map_are_other_frames(empty, uploads):
    data, meta = uploads[0].data, uploads[0].meta
    empty.create_map(NewMap(name="other", model="depth"))
    image = np.array(Image.open(io.BytesIO(data)))
    image[np.unravel_index(image.argmax(), image.shape)] -= 1  # one millimetre of one pixel
    out = io.BytesIO()
    Image.fromarray(image).save(out, "PNG")
    camera = meta.intrinsics.model_dump() | {"fx": meta.intrinsics.fx + 1e-6}
    added = [
        empty.add_frame("hall", data, meta),
        empty.add_frame("hall", out.getvalue(), meta),
        empty.add_frame("hall", data, with_(meta, intrinsics=camera)),
        empty.add_frame("other", data, meta),
    ]
    assert [new for _, new in added] == [True] * 4
    assert len({each.frame_id for each, _ in added}) == 4
    assert len(blobs(empty)) == 2


def test_what_cannot_be_a_frame_is_refused_and_not_kept(empty, uploads):
    data, meta = uploads[0].data, uploads[0].meta
    small = meta.intrinsics.model_dump() | {"width": 320, "height": 240}
    with pytest.raises(InvalidIntrinsics, match="640 x 480 pixels"):
        empty.add_frame("hall", data, with_(meta, intrinsics=small))
    out = io.BytesIO()
    Image.fromarray(np.zeros((480, 640), np.uint16)).save(out, "PNG")
    with pytest.raises(UselessFrame, match="All 307200 samples are missing"):
        empty.add_frame("hall", out.getvalue(), meta)
    assert blobs(empty) == []
    assert empty.statistics.state_counts() == ({}, {})


@pytest.mark.parametrize("how", ["frame", "map"])
def test_blobs_stay_while_another_map_refers_to_them(empty, uploads, how):
    empty.create_map(NewMap(name="other", model="depth"))
    added = {}
    for name in ("hall", "other"):
        added[name], _ = empty.add(uploads[0], name)
    assert empty.work_off() == [JobState.SUCCEEDED] * 2
    both = blobs(empty)
    assert len(both) == 2
    empty.tombstones = Tombstones(empty.store, 0.0, empty.bell.ring)
    for name, left in (("hall", both), ("other", [])):
        if how == "map":
            empty.delete_map(name)
        else:
            empty.delete_frame(name, added[name].frame_id)
        assert blobs(empty) == left


def test_an_upload_into_a_map_that_is_made_anew_meanwhile_is_in_the_new_one(
    empty, uploads, monkeypatch
):
    put = empty.store.blobs.put

    def made_anew(data):
        digest = put(data)
        monkeypatch.undo()
        empty.delete_map("hall")
        empty.create_map(NewMap(name="hall"))
        return digest

    monkeypatch.setattr(empty.store.blobs, "put", made_anew)
    added, new = empty.add(uploads[0])
    assert new
    assert len(blobs(empty)) == 1
    assert empty.get_frame("hall", added.frame_id).state == FrameState.RECEIVED


HERE = LocalDecoders(1)


def points_of(frame):
    depth, k = frame.depth[::2, ::2].astype(float), frame.intrinsics
    y, x = np.nonzero(depth)
    z = depth[y, x]
    points = np.stack([(2 * x - k.cx) / k.fx * z, (2 * y - k.cy) / k.fy * z, z], axis=1)
    return points.astype(np.float32).astype(float)


def test_what_could_not_be_read_again_is_not_let_in():
    odd = write_ply(np.eye(3)[np.arange(12) % 3]).replace(b"ply\n", b"ply\t\n", 1)
    with pytest.raises(UnreadableCloud, match="does not have the magic bytes"):
        read_upload(odd, FrameMeta(format="ply"), HERE)


def test_minus_nought_is_no_other_viewpoint():
    data = write_ply(np.eye(3)[np.arange(12) % 3])
    mine = read_upload(data, FrameMeta(viewpoint={"x": -0.0, "y": 0, "z": -0.0}), HERE)
    assert content_id(mine) == content_id(read_upload(data, FrameMeta(), HERE))


def test_what_is_behind_a_match_without_a_viewpoint_can_be_looked_at(empty, uploads):
    points = write_ply(points_of(uploads[0].frame))
    frame_id = empty.add_frame("hall", points, FrameMeta(viewpoint=None))[0].frame_id
    image_id = empty.add(uploads[1])[0].frame_id
    assert empty.work_off() == [JobState.SUCCEEDED] * 2
    for view in ("depth", "normals", "patches"):
        assert empty.outputs.preview("hall", frame_id, view).make().startswith(b"\x89PNG")
    answer = empty.queries.upload(
        ["hall"], points, FrameMeta(viewpoint=None), Query(k=2, explain=True)
    )
    tried = {match.frame_id: match.validation for match in answer.matches}
    assert tried[frame_id].free_space_violations is None
    assert tried[image_id].free_space_violations is not None  # the image knows of free space
    result = {explanation.frame_id: explanation.reason for explanation in answer.explanations or ()}
    assert "violations unknown" in result[frame_id]
    details = empty.inspection.match(answer.query_id, frame_id)
    assert details.query.violations == []
    assert len(details.query.inliers) > 100
    for colour in ("source", "normal", "residual"):
        laid = empty.inspection.overlay(answer.query_id, frame_id, colour=colour)
        assert laid.startswith(b"ply\n")
    assert empty.inspection.cloud(answer.query_id).startswith(b"ply\n")


CAMERA = {"width": 4, "height": 3, "fx": 2, "fy": 2, "cx": 2, "cy": 1}
EYE = np.eye(4).tolist()
ORIGIN = {"x": 0, "y": 0, "z": 0}
LEVEL = {"x": 0, "y": 0, "z": 0, "w": 1}


def meta(**more):
    return {"intrinsics": CAMERA} | more


REFUSED = [
    (Query, {"k": 51}, "k"),
    (Query, {"seed": 2**32}, "seed"),
    (Query, {"stages": ["retrieve", "retrieve"]}, "stages"),
    (FrameMeta, {"viewpoint": {"x": 0, "y": 0}}, "viewpoint.GivenVector.z"),
    (FrameMeta, meta(intrinsics=CAMERA | {"width": 0}), "intrinsics.width"),
    (FrameMeta, meta(intrinsics=CAMERA | {"distortion": [math.nan]}), "intrinsics.distortion.0"),
    (FrameMeta, meta(intrinsics=CAMERA | {"distortion": [0] * 9}), "intrinsics.distortion"),
    (FrameMeta, meta(depth_scale=0), "depth_scale"),
    (FrameMeta, meta(robot="r\0"), "robot"),
    (FrameMeta, meta(tags=["a", ""]), "tags.1"),
    (FrameMeta, meta(captured_at="2026-01-01T00:00:00"), "captured_at"),
    (FrameMeta, meta(captured_at="9999-12-31T23:59:59-12:00"), "captured_at"),
    (GivenPose, {}, ""),
    (GivenPose, {"translation": ORIGIN, "rotation": LEVEL, "matrix": EYE}, ""),
    (GivenPose, {"matrix": EYE[:3]}, "matrix"),
    (GivenPose, {"matrix": [[math.nan, 0, 0, 0], *EYE[1:]]}, "matrix.0.0"),
    (GivenPose, {"translation": ORIGIN | {"x": math.inf}, "rotation": LEVEL}, "translation.x"),
]


@pytest.mark.parametrize(("kind", "fields", "place"), REFUSED)
def test_what_would_mean_nothing_is_refused_at_its_place(kind, fields, place):
    with pytest.raises(ValidationError) as caught:
        kind.model_validate(fields)
    assert place in [".".join(map(str, e["loc"])) for e in caught.value.errors()]
    with pytest.raises(ValidationError):
        kind.model_validate_json(json.dumps(fields))


@pytest.mark.parametrize("seed", range(2))
def test_both_ways_of_a_pose_are_one(seed):
    rotation, t = Rotation.random(random_state=seed), [1.5, -2.25, 1e3]
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation.as_matrix(), t
    x, y, z, w = (rotation.as_quat() * 1.005).tolist()  # as rounded somewhere
    parts = {
        "translation": {"x": t[0], "y": t[1], "z": t[2]},
        "rotation": {"x": x, "y": y, "z": z, "w": w},
    }
    by_parts = pose_matrix(GivenPose.model_validate(parts))
    by_matrix = pose_matrix(GivenPose(matrix=T.tolist()))
    np.testing.assert_allclose(by_parts, T, rtol=0, atol=1e-14)
    np.testing.assert_allclose(by_matrix, T, rtol=0, atol=1e-14)
    result = transform(by_parts, "map", "camera")
    assert (result.parent_frame, result.child_frame) == ("map", "camera")
    assert result.matrix == by_parts.tolist()
    assert list(result.translation.model_dump().values()) == t
    quaternion = np.array(
        [result.rotation.x, result.rotation.y, result.rotation.z, result.rotation.w]
    )
    theirs = rotation.as_quat()
    np.testing.assert_allclose(quaternion, theirs * np.sign(theirs[3]), rtol=0, atol=1e-14)


@pytest.mark.parametrize("length", [0.0, 0.5, 0.98, 1.02, 2.0, 1e200])
def test_a_quaternion_that_is_not_of_unit_length_is_no_rotation(length):
    q = {"x": 0.0, "y": 0.6 * length, "z": 0.0, "w": 0.8 * length}
    with np.errstate(over="ignore"), pytest.raises(InvalidPose, match=r"quaternion .* has length"):
        pose_matrix(GivenPose.model_validate({"translation": ORIGIN, "rotation": q}))
