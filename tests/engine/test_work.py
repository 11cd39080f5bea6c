"""Tests of frames that cannot be signed, and of workers that finish too late."""

import io

import numpy as np
import pytest
from PIL import Image

from sceneprint.engine.maps.tombstones import Tombstones
from sceneprint.store.maps import find_map
from sceneprint.store.signatures import changes_since
from sceneprint_client.api import FrameMeta, FrameState, JobState
from tests.engine.conftest import packed_again


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


def test_a_frame_whose_blob_is_gone_is_tried_thrice_and_failed(empty, uploads, told, due_now):
    added, _ = empty.add_frame("hall", uploads[0].data, uploads[0].meta)
    remove_blob(empty, uploads[0].data)
    for _ in range(2):
        claimed = empty.claim("w")
        assert empty.get_frame("hall", added.frame_id).state == FrameState.SIGNING
        assert empty.run(claimed) == JobState.QUEUED
        frame = empty.get_frame("hall", added.frame_id)
        assert (frame.state, frame.reason) == (FrameState.RECEIVED, None)
        assert empty.claim("w") is None  # not at once
        due_now(empty)
    assert empty.run(empty.claim("w")) == JobState.DEAD
    frame, job = empty.get_frame("hall", added.frame_id), empty.get_job(added.job_id)
    assert (frame.state, job.state, job.attempts) == (FrameState.FAILED, JobState.DEAD, 3)
    assert frame.reason == job.error
    assert "cannot be read (No such file or directory)" in frame.reason
    assert "DamagedBlob" in job.traceback
    assert told(empty) == ["map.created", "frame.received", "frame.failed"]
    # sent once more, in another packing, it is tried once more: the same frame, another job
    again, new = empty.add_frame("hall", packed_again(uploads[0].data), uploads[0].meta)
    assert (again.frame_id, new, again.state) == (added.frame_id, True, FrameState.RECEIVED)
    assert again.job_id != added.job_id
    assert empty.run(empty.claim("w")) == JobState.SUCCEEDED
    frame = empty.get_frame("hall", added.frame_id)
    assert (frame.state, frame.reason, frame.job_id) == (FrameState.INDEXED, None, again.job_id)
    assert len(list(empty.store.blobs.digests())) == 2  # upload and artifact


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
