"""Tests of the client's methods for maps, frames and jobs."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.errors import (
    CannotRetry,
    FrameConflict,
    InvalidRequest,
    JobOver,
    MapExists,
    UnknownFrame,
    UnknownJob,
    UnknownMap,
)
from sceneprint.formats.dataset import FrameReference
from sceneprint_client import Client, meta_of
from sceneprint_client.api import FrameState, JobState


def test_maps(client: Client, map_name: str) -> None:
    made = client.create_map(map_name, "Hall 2", "depth")
    assert (made.name, made.title, made.revision) == (map_name, "Hall 2", 0)
    assert made.model.startswith("depth-")
    assert made.model.endswith(made.model_id[:12])
    assert client.create_map(map_name, "Hall 2", "depth") == made
    assert client.map(map_name) == made
    assert made in client.maps()
    with pytest.raises(MapExists):
        client.create_map(map_name, "Hall 3", "depth")
    client.delete_map(map_name)
    with pytest.raises(UnknownMap, match=map_name):
        client.map(map_name)
    with pytest.raises(UnknownMap, match=map_name):
        client.delete_map(map_name)
    assert made not in client.maps()


def test_a_frame_from_upload_to_deletion(
    client: Client, map_name: str, references: tuple[FrameReference, ...]
) -> None:
    client.create_map(map_name)
    reference = references[0]
    added = client.upload(map_name, reference, wait_s=PATIENCE_S)
    assert (added.state, added.reason) == (FrameState.INDEXED, None)
    frame = client.frame(map_name, added.frame_id)
    assert (frame.map, frame.state, frame.job_id) == (map_name, "indexed", added.job_id)
    assert (frame.session, frame.robot, frame.tags) == ("room-0/seq-01", None, [])
    assert frame.bytes == reference.path.stat().st_size
    assert frame.pose is not None
    assert frame.pose.parent_frame == "room-0/seq-01"
    np.testing.assert_allclose(frame.pose.matrix, reference.pose, atol=1e-12)
    assert frame.intrinsics.fx == reference.camera.intrinsics.fx
    job = client.job(added.job_id)
    assert (job.state, job.frame_id, job.attempts) == (JobState.SUCCEEDED, added.frame_id, 1)
    again, new = client.add(map_name, reference)
    assert (again.frame_id, again.state, new) == (added.frame_id, FrameState.INDEXED, False)
    with pytest.raises(FrameConflict, match=r"different robot, tags, pose\.parent_frame\."):
        client.upload(map_name, reference, meta_of(reference, robot="r2", tags=["b"]))
    assert client.map(map_name).frames["indexed"] == 1
    client.delete_frame(map_name, added.frame_id)
    with pytest.raises(UnknownFrame):
        client.delete_frame(map_name, added.frame_id)
    assert list(client.frames(map_name)) == []
    assert [one.frame_id for one in client.frames(map_name, FrameState.DELETED)] == [added.frame_id]


def test_jobs_are_waited_for(
    client: Client, map_name: str, references: tuple[FrameReference, ...], bare_wall: Path
) -> None:
    client.create_map(map_name)
    added = [client.upload(map_name, one) for one in (*references[:2], bare_wall)]
    seen: list[tuple[int, int]] = []
    ids = [one.job_id for one in added]
    jobs = client.wait([*ids, ids[0]], timeout_s=PATIENCE_S, progress=lambda *n: seen.append(n))
    assert [job.job_id for job in jobs] == [*ids, ids[0]]
    assert [job.state for job in jobs] == ["succeeded", "succeeded", "failed", "succeeded"]
    assert seen[-1] == (3, 3)
    assert seen == sorted(seen)
    wall = client.frame(map_name, added[2].frame_id)
    assert wall.state is FrameState.REJECTED
    assert wall.reason == jobs[2].error
    assert "only 30 of its 30 valid depth samples" in str(wall.reason)
    assert [one.frame_id for one in client.frames(map_name)] == [one.frame_id for one in added]
    rejected = client.frames(map_name, FrameState.REJECTED)
    assert [one.frame_id for one in rejected] == [added[2].frame_id]


def test_jobs_that_are_over(
    client: Client, map_name: str, references: tuple[FrameReference, ...], bare_wall: Path
) -> None:
    client.create_map(map_name, model="depth")
    good = client.upload(map_name, references[0], wait_s=PATIENCE_S, priority=-10)
    wall = client.upload(map_name, bare_wall, wait_s=PATIENCE_S)
    assert [client.job(one.job_id).priority for one in (good, wall)] == [-10, 0]
    with pytest.raises(JobOver, match="is succeeded"):
        client.cancel_job(good.job_id)
    with pytest.raises(CannotRetry):
        client.retry_job(good.job_id)
    again = client.retry_job(wall.job_id)
    assert (again.frame_id, again.job_id != wall.job_id) == (wall.frame_id, True)
    (done,) = client.wait([again.job_id], timeout_s=PATIENCE_S)
    assert done.state is JobState.FAILED
    assert client.frame(map_name, wall.frame_id).state is FrameState.REJECTED
    with pytest.raises(CannotRetry):
        client.retry_job(wall.job_id)
    own = [job.job_id for job in client.jobs() if job.map == map_name]
    assert own == [again.job_id, wall.job_id, good.job_id]
    assert [j.job_id for j in client.jobs(JobState.SUCCEEDED) if j.map == map_name] == own[2:]
    for ask in (client.cancel_job, client.retry_job):
        for name in ("nobody", "..", ""):
            with pytest.raises(UnknownJob):
                ask(name)
    for priority in (-11, 11):
        with pytest.raises(InvalidRequest, match=f"is {priority}") as told:
            client.upload(map_name, references[1], priority=priority)
        assert told.value.fields == (("priority", "out of range"),)


def test_a_job_is_cancelled_before_anybody_waits_for_it(
    embedded: Client, references: tuple[FrameReference, ...]
) -> None:
    embedded.create_map("m", model="depth")
    first = embedded.upload("m", references[0])
    assert embedded.cancel_job(first.job_id).state is JobState.CANCELLED
    late = embedded.upload("m", references[1], priority=5)
    again = embedded.retry_job(first.job_id)
    assert embedded.retry_job(first.job_id) == again
    jobs = embedded.wait([again.job_id, late.job_id], timeout_s=PATIENCE_S)
    assert [job.state for job in jobs] == ["succeeded", "succeeded"]
    assert jobs[0].started_at is not None
    assert jobs[1].started_at is not None
    assert jobs[1].started_at < jobs[0].started_at  # of a greater priority


def test_many_jobs_come_in_pages(embedded: Client, references: tuple[FrameReference, ...]) -> None:
    embedded.create_map("m", model="depth")
    added = [embedded.upload("m", references[0]).job_id]
    while len(added) < 103:
        embedded.cancel_job(added[-1])
        added.append(embedded.retry_job(added[-1]).job_id)
    assert [job.job_id for job in embedded.jobs()] == added[::-1]
    assert [job.job_id for job in embedded.jobs(JobState.CANCELLED)] == added[-2::-1]


def test_a_wait_ends_when_its_time_is_over(
    embedded: Client, references: tuple[FrameReference, ...]
) -> None:
    embedded.create_map("m")
    added = embedded.upload("m", references[0])
    assert added.state is FrameState.RECEIVED
    (job,) = embedded.wait([added.job_id], timeout_s=0)
    assert (job.state, job.state.over, job.attempts) == (JobState.QUEUED, False, 0)
    status = embedded.status()
    assert (status.frames["received"], status.jobs) == (1, {"queued": 1})
    (job,) = embedded.wait([added.job_id], timeout_s=PATIENCE_S)
    assert job.state is JobState.SUCCEEDED


def test_what_is_not_there(client: Client, map_name: str) -> None:
    client.create_map(map_name)
    for name in ("nobody", "", "..", "a/b", "Ä"):
        with pytest.raises(UnknownMap):
            client.map(name)
        with pytest.raises(UnknownFrame):
            client.frame(map_name, name)
        with pytest.raises(UnknownFrame):
            client.delete_frame(map_name, name)
        with pytest.raises(UnknownJob):
            client.job(name)
    with pytest.raises(UnknownMap):
        next(client.frames("nobody"))
    assert client.map(map_name).name == map_name


def test_threads_share_a_client(
    client: Client, map_name: str, references: tuple[FrameReference, ...]
) -> None:
    client.create_map(map_name, model="depth")
    with ThreadPoolExecutor(6) as pool:
        both = (*references, *references)  # each frame twice at the same time
        added = list(pool.map(lambda one: client.add(map_name, one), both))
        assert sum(new for _, new in added) == len(references)
        ids = {one.frame_id for one, _ in added}
        client.wait({one.job_id for one, _ in added})
        answers = list(pool.map(lambda i: client.query(map_name, frame_id=i, k=1), ids))
    assert len(ids) == len(references)
    assert {answer.counts.map for answer in answers} == {len(references) - 1}


def test_healthy(client: Client) -> None:
    assert client.healthy()
    assert client.status().version
