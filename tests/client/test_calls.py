"""Tests of the client's methods for maps, frames and jobs."""

import numpy as np
import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.errors import (
    CannotRetry,
    FrameConflict,
    InvalidRequest,
    JobOver,
    UnknownFrame,
    UnknownJob,
    UnknownMap,
)
from sceneprint_client import meta_of
from sceneprint_client.api import FrameState, JobState


def test_a_frame_from_upload_to_deletion(client, map_name, references):
    client.create_map(map_name)
    reference = references[0]
    added = client.upload(map_name, reference, wait_s=PATIENCE_S)
    assert (added.state, added.reason) == (FrameState.INDEXED, None)
    frame = client.frame(map_name, added.frame_id)
    assert (frame.session, frame.robot, frame.tags) == ("room-0/seq-01", None, [])
    assert frame.pose.parent_frame == "room-0/seq-01"
    np.testing.assert_allclose(frame.pose.matrix, reference.pose, atol=1e-12)
    assert frame.intrinsics.fx == reference.camera.intrinsics.fx
    again, new = client.add(map_name, reference)
    assert (again.frame_id, again.state, new) == (added.frame_id, FrameState.INDEXED, False)
    with pytest.raises(FrameConflict, match=r"different robot, tags, pose\.parent_frame\."):
        client.upload(map_name, reference, meta_of(reference, robot="r2", tags=["b"]))
    assert client.map(map_name).frames["indexed"] == 1
    client.delete_frame(map_name, added.frame_id)
    with pytest.raises(UnknownFrame):
        client.delete_frame(map_name, added.frame_id)
    assert list(client.frames(map_name)) == []
    assert [f.frame_id for f in client.frames(map_name, FrameState.DELETED)] == [added.frame_id]


def test_jobs_are_waited_for(client, map_name, references):
    client.create_map(map_name)
    lens = meta_of(references[0]).intrinsics
    wall = np.zeros((lens.height, lens.width), np.float32)
    wall[100:105, 100:106] = 2.0  # no surface to sign: 30 samples
    added = [client.upload(map_name, reference) for reference in references[:2]]
    added.append(client.upload(map_name, wall, lens))
    seen = []
    ids = [frame.job_id for frame in added]
    jobs = client.wait([*ids, ids[0]], timeout_s=PATIENCE_S, progress=lambda *n: seen.append(n))
    assert [job.job_id for job in jobs] == [*ids, ids[0]]
    assert [job.state for job in jobs] == ["succeeded", "succeeded", "failed", "succeeded"]
    assert seen[-1] == (3, 3)
    assert seen == sorted(seen)
    wall = client.frame(map_name, added[2].frame_id)
    assert wall.state is FrameState.REJECTED
    assert wall.reason == jobs[2].error
    assert "only 30 of its 30 valid depth samples" in str(wall.reason)
    rejected = client.frames(map_name, FrameState.REJECTED)
    assert [one.frame_id for one in rejected] == [added[2].frame_id]


def test_a_job_is_cancelled_before_anybody_waits_for_it(embedded, references):
    embedded.create_map("m", model="depth")
    first = embedded.upload("m", references[0])
    assert embedded.cancel_job(first.job_id).state is JobState.CANCELLED
    late = embedded.upload("m", references[1], priority=5)
    again = embedded.retry_job(first.job_id)
    assert embedded.retry_job(first.job_id) == again
    jobs = embedded.wait([again.job_id, late.job_id], timeout_s=PATIENCE_S)
    assert [job.state for job in jobs] == ["succeeded", "succeeded"]
    with pytest.raises(JobOver, match="is succeeded"):
        embedded.cancel_job(late.job_id)
    with pytest.raises(CannotRetry):
        embedded.retry_job(late.job_id)
    assert [job.job_id for job in embedded.jobs(JobState.CANCELLED)] == [first.job_id]
    assert jobs[1].started_at < jobs[0].started_at  # of a greater priority


def test_what_is_not_there(client, map_name, references):
    client.create_map(map_name)
    for priority in (-11, 11):
        with pytest.raises(InvalidRequest, match=f"is {priority}") as error:
            client.upload(map_name, references[1], priority=priority)
        assert error.value.fields == (("priority", "out of range"),)
    for name in ("nobody", "", "..", "a/b", "Ä"):
        with pytest.raises(UnknownMap):
            client.map(name)
        with pytest.raises(UnknownFrame):
            client.delete_frame(map_name, name)
        with pytest.raises(UnknownJob):
            client.cancel_job(name)
    with pytest.raises(UnknownMap):
        next(client.frames("nobody"))
    assert client.map(map_name).name == map_name
