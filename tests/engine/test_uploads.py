"""Tests of uploads: repetition, conflicts and deletion."""

import io

import numpy as np
import pytest
from PIL import Image
from sqlalchemy import event, update

from sceneprint.engine.maps.tombstones import Tombstones
from sceneprint.errors import (
    FrameConflict,
    InvalidIntrinsics,
    UselessFrame,
)
from sceneprint.store.tables import jobs
from sceneprint_client.api import FrameMeta, FrameState, JobState, NewMap, Query
from tests.engine.conftest import packed_again

ASK = Query(stages=("retrieve",), k=50)


def blobs(engine):
    return sorted(engine.store.blobs.digests())


def with_(meta, **more):
    return FrameMeta.model_validate(meta.model_dump() | more)


def test_the_same_upload_is_the_frame_that_is_there(empty, uploads, work_off, told):
    data, meta = uploads[0].data, uploads[0].meta
    first, new = empty.add_frame("hall", data, meta)
    assert (new, first.state, first.reason) == (True, FrameState.RECEIVED, None)
    assert empty.get_frame("hall", first.frame_id).state == FrameState.RECEIVED
    assert empty.add_frame("hall", data, meta) == (first, False)
    assert empty.add_frame("hall", packed_again(data, 0), meta) == (first, False)
    assert len(blobs(empty)) == 1  # other bytes of the same frame are not kept
    assert work_off(empty) == [JobState.SUCCEEDED]
    again, new = empty.add_frame("hall", packed_again(data, 9), meta)
    assert (again.frame_id, again.job_id, new) == (first.frame_id, first.job_id, False)
    assert again.state == FrameState.INDEXED
    assert told(empty) == ["map.created", "frame.received", "frame.indexed"]
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
    added, new = empty.add_frame("hall", uploads[0].data, uploads[0].meta)
    assert new
    found = empty.get_frame("hall", added.frame_id)
    assert empty.get_map("hall").frames == {"received": 1}
    assert [empty.store.blobs.get(one) for one in blobs(empty)] == [uploads[0].data]
    assert found.state == FrameState.RECEIVED


def test_a_signature_whose_artifact_is_swept_before_its_commit_is_made_again(
    empty, uploads, work_off
):
    added, _ = empty.add_frame("hall", uploads[0].data, uploads[0].meta)
    (upload,) = blobs(empty)
    claimed = empty.claim("w")
    sweep_before(empty, "INSERT INTO signatures", lambda: [b for b in blobs(empty) if b != upload])
    if empty.store.database.is_sqlite:
        assert empty.run(claimed) == JobState.QUEUED
        assert empty.get_frame("hall", added.frame_id).state == FrameState.RECEIVED
        empty.write(update(jobs).values(run_after=0.0))
        assert work_off(empty) == [JobState.SUCCEEDED]
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
        said = f"Frame {added.frame_id} has the same content, but a different {fields}. A map"
        assert str(caught.value).startswith(said)
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
def test_blobs_stay_while_another_map_refers_to_them(empty, uploads, work_off, how):
    empty.create_map(NewMap(name="other", model="depth"))
    added = {}
    for name in ("hall", "other"):
        added[name], _ = empty.add_frame(name, uploads[0].data, uploads[0].meta)
    assert work_off(empty) == [JobState.SUCCEEDED] * 2
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
    added, new = empty.add_frame("hall", uploads[0].data, uploads[0].meta)
    assert new
    assert len(blobs(empty)) == 1
    assert empty.get_frame("hall", added.frame_id).state == FrameState.RECEIVED
