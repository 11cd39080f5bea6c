"""Tests of frames that cannot be signed, and of workers that finish too late."""

import io

import numpy as np
import pytest
from PIL import Image

from sceneprint.engine.maps.tombstones import Tombstones
from sceneprint.store.maps import find_map
from sceneprint.store.signatures import changes_since
from sceneprint_client.api import FrameMeta, FrameState, JobState


def png(samples):
    out = io.BytesIO()
    Image.fromarray(samples.astype(np.uint16)).save(out, "PNG")
    return out.getvalue()


def lone_pixel():
    samples = np.zeros((480, 640))
    samples[240, 320] = 2000
    return samples


def far_away():
    return np.full((480, 640), 60_000)


def changes(engine):
    with engine.store.database.read() as connection:
        row = find_map(connection, "hall")
        return [one for block in changes_since(connection, row, 0) for one in block]


def remove_blob(engine, data):
    engine.store.blobs.remove(engine.store.blobs.put(data))


@pytest.mark.parametrize("samples", [lone_pixel(), far_away()])
def test_a_frame_with_nothing_to_sign_is_rejected_with_the_reason(
    empty, uploads, told, work_off, samples
):
    meta = FrameMeta(intrinsics=uploads[0].meta.intrinsics)
    added, _ = empty.add_frame("hall", png(samples), meta)
    assert work_off(empty) == [JobState.FAILED]
    frame, job = empty.get_frame("hall", added.frame_id), empty.get_job(added.job_id)
    assert frame.state == FrameState.REJECTED
    assert frame.reason == job.error
    assert frame.reason
    assert added.frame_id not in frame.reason
    assert (job.state, job.attempts, job.traceback) == (JobState.FAILED, 1, None)
    assert job.finished_at is not None
    assert told(empty)[-1] == "frame.rejected"
    again, new = empty.add_frame("hall", png(samples), meta)
    assert (new, again.state, again.reason) == (False, FrameState.REJECTED, frame.reason)
    assert changes(empty) == []
    assert empty.get_map("hall").revision == 0
    empty.tombstones = Tombstones(empty.store, 0.0, empty.bell.ring)
    empty.delete_frame("hall", added.frame_id)
    assert list(empty.store.blobs.digests()) == []
    assert empty.get_job(added.job_id).state == JobState.FAILED


def packed(data):
    """The same pixels as another PNG."""
    out = io.BytesIO()
    Image.open(io.BytesIO(data)).save(out, "PNG", compress_level=0)
    assert out.getvalue() != data
    return out.getvalue()


def test_a_frame_whose_blob_is_gone_is_tried_thrice_and_failed(empty, uploads, told, due_now):
    added, _ = empty.add_frame("hall", uploads[0].data, uploads[0].meta)
    remove_blob(empty, uploads[0].data)
    for attempt in (1, 2):
        claimed = empty.claim("w")
        assert claimed is not None
        assert empty.get_frame("hall", added.frame_id).state == FrameState.SIGNING
        assert empty.run(claimed) == JobState.QUEUED
        job = empty.get_job(added.job_id)
        assert (job.state, job.attempts, job.finished_at) == (JobState.QUEUED, attempt, None)
        frame = empty.get_frame("hall", added.frame_id)
        assert (frame.state, frame.reason) == (FrameState.RECEIVED, None)
        assert empty.claim("w") is None  # not at once
        due_now(empty)
    claimed = empty.claim("w")
    assert claimed is not None
    assert empty.run(claimed) == JobState.DEAD
    frame, job = empty.get_frame("hall", added.frame_id), empty.get_job(added.job_id)
    assert (frame.state, job.state, job.attempts) == (FrameState.FAILED, JobState.DEAD, 3)
    assert frame.reason == job.error
    assert frame.reason is not None
    assert "cannot be read (No such file or directory)" in frame.reason
    assert job.traceback is not None
    assert "DamagedBlob" in job.traceback
    assert "read_stored" in job.traceback
    assert told(empty) == ["map.created", "frame.received", "frame.failed"]
    # sent once more, in another packing, it is tried once more: the same frame, another job
    again, new = empty.add_frame("hall", packed(uploads[0].data), uploads[0].meta)
    assert (again.frame_id, new, again.state) == (added.frame_id, True, FrameState.RECEIVED)
    assert again.job_id != added.job_id
    claimed = empty.claim("w")
    assert claimed is not None
    assert empty.run(claimed) == JobState.SUCCEEDED
    frame = empty.get_frame("hall", added.frame_id)
    assert (frame.state, frame.reason, frame.job_id) == (FrameState.INDEXED, None, again.job_id)
    assert len(list(empty.store.blobs.digests())) == 2  # upload and artifact
    due_now(empty)
    assert empty.claim("w") is None


def test_a_frame_whose_blob_comes_back_is_signed_after_all(empty, uploads, due_now, work_off):
    added, _ = empty.add_frame("hall", uploads[0].data, uploads[0].meta)
    remove_blob(empty, uploads[0].data)
    assert work_off(empty) == [JobState.QUEUED]
    empty.store.blobs.put(uploads[0].data)
    due_now(empty)
    assert work_off(empty) == [JobState.SUCCEEDED]
    job = empty.get_job(added.job_id)
    assert (job.attempts, job.error, job.traceback) == (2, None, None)
    assert empty.get_frame("hall", added.frame_id).state == FrameState.INDEXED


def test_a_worker_that_comes_late_changes_nothing(empty, uploads, due_now, told):
    added, _ = empty.add_frame("hall", uploads[0].data, uploads[0].meta)
    first = empty.claim("first")
    due_now(empty)
    second = empty.claim("second")
    assert (first.job.token, second.job.token) == (1, 2)
    assert empty.run(first) is None
    assert changes(empty) == []
    assert empty.get_frame("hall", added.frame_id).state == FrameState.SIGNING
    remove_blob(empty, uploads[0].data)
    assert empty.run(first) is None  # nor does its trouble count
    assert empty.get_job(added.job_id).error is None
    empty.put_back(first)
    assert empty.get_job(added.job_id).state == JobState.RUNNING
    assert empty.get_frame("hall", added.frame_id).state == FrameState.SIGNING
    empty.store.blobs.put(uploads[0].data)
    assert empty.run(second) == JobState.SUCCEEDED
    assert len(changes(empty)) == 1
    assert told(empty) == ["map.created", "frame.received", "frame.indexed"]


@pytest.mark.parametrize("how", ["frame", "map"])
def test_what_is_deleted_while_it_is_signed_stays_deleted(empty, uploads, told, how):
    added, _ = empty.add_frame("hall", uploads[0].data, uploads[0].meta)
    claimed = empty.claim("w")
    assert claimed is not None
    if how == "map":
        empty.delete_map("hall")
    else:
        empty.delete_frame("hall", added.frame_id)
        assert empty.get_job(added.job_id).state == JobState.CANCELLED
    empty.store.blobs.put(uploads[0].data)  # it had read it before
    assert empty.run(claimed) is None
    assert told(empty)[-1] == f"{how}.deleted"
    if how == "frame":
        assert empty.get_frame("hall", added.frame_id).state == FrameState.DELETED
        assert empty.get_map("hall").revision == 1
    empty.store.blobs.remove(empty.store.blobs.put(uploads[0].data))
    assert list(empty.store.blobs.digests()) == []  # nor is what it made kept


def test_a_job_that_silences_every_worker_is_given_up(empty, uploads, due_now, told):
    bad, _ = empty.add_frame("hall", uploads[0].data, uploads[0].meta)
    for attempt in range(1, 11):
        claimed = empty.claim("w")  # and dies
        assert claimed.job.attempts == attempt
        due_now(empty)
    good, _ = empty.add_frame("hall", uploads[1].data, uploads[1].meta)
    claimed = empty.claim("w")
    assert claimed.frame.id == good.frame_id
    frame, job = empty.get_frame("hall", bad.frame_id), empty.get_job(bad.job_id)
    assert (frame.state, job.state) == (FrameState.FAILED, JobState.DEAD)
    assert frame.reason == job.error == "its worker stopped responding in the last of 10 attempts"
    assert told(empty) == ["map.created", "frame.received", "frame.received", "frame.failed"]


def test_what_is_put_back_is_as_it_was(empty, uploads, work_off):
    added, _ = empty.add_frame("hall", uploads[0].data, uploads[0].meta)
    for _ in range(4):
        claimed = empty.claim("w")
        assert claimed is not None
        empty.put_back(claimed)
        assert empty.get_frame("hall", added.frame_id).state == FrameState.RECEIVED
        assert empty.get_job(added.job_id).attempts == 0
    assert work_off(empty) == [JobState.SUCCEEDED]
