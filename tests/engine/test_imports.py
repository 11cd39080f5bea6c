"""Tests that an import continues after its last stored slice."""

import io
import json
import tarfile
from contextlib import ExitStack

import pytest

from sceneprint.engine.ingest import archive_import
from sceneprint.engine.jobs.lifecycle import cancel, list_jobs, worker_died
from sceneprint.engine.maps.map_lifecycle import edit_map
from sceneprint.engine.upkeep.garbage_collection import collect_blobs
from sceneprint.errors import Conflict, LostLease, QuotaExceeded, UnknownMap
from sceneprint.store.queue import MAXIMUM_FAILURES, files_of
from sceneprint_client.api import JobState
from sceneprint_client.api.frames import ImportOptions, UploadSummary, pooled_range
from tests.engine.conftest import Between, begin_import, bytes_on_disk, claim_long, used


def packed(uploads):
    made = io.BytesIO()
    camera = uploads[0].meta.intrinsics.model_dump(exclude={"distortion"})
    with tarfile.open(fileobj=made, mode="w:gz") as archive:
        members = {"run/intrinsics.json": json.dumps(camera).encode()}
        members |= {f"run/{i}.png": one.data for i, one in enumerate(uploads)}
        for name, data in members.items():
            info = tarfile.TarInfo(name)
            info.size = len(data)
            archive.addfile(info, io.BytesIO(data))
    return made.getvalue()


def test_a_slice_that_was_lost_is_done_again(empty, uploads, monkeypatch):
    monkeypatch.setattr(archive_import, "_AT_ONCE", 2)
    job = begin_import(empty, packed(uploads[:5]))
    task = claim_long(empty)
    # at least some are taken, so that it comes to an end
    lost = empty.imports.handle(task, lambda: True)  # and is never stored: its worker died
    assert [one["status"] for one in lost.items] == [202, 202]
    assert lost.progress["done"] == 2
    assert list(empty.imports.items("hall", job.job_id).items) == []
    again = empty.imports.handle(task, lambda: True)
    assert [one["status"] for one in again.items] == [200, 200]
    assert [one["frame_id"] for one in again.items] == [one["frame_id"] for one in lost.items]
    assert empty.run(task) == JobState.SUCCEEDED  # there is time for all now
    told = empty.get_job(job.job_id)
    summary = UploadSummary.model_validate(told.result.pop("summary"))
    assert told.result == {
        "sequences": 1, "received": 3, "there": 2, "refused": 0, "ignored": 0,
    }  # fmt: skip
    # of all slices, those of the frames that were there as well
    assert (summary.frames, summary.poses, summary.lost) == (5, 0, 0)
    assert list(summary.without_pose.values()) == [5]
    items = empty.imports.items("hall", job.job_id).items
    depth = pooled_range(one.samples for one in items if one.samples is not None)
    assert summary.depth == depth
    assert depth.count == sum(one.samples.count for one in items if one.samples is not None)
    page = empty.imports.items("hall", job.job_id, limit=3)
    rest = empty.imports.items("hall", job.job_id, page.next_cursor, 3)
    assert [one.name for one in (*page.items, *rest.items)] == [f"run/{i}.png" for i in range(5)]
    assert rest.next_cursor is None
    assert len(empty.list_frames("hall").items) == 5


def test_an_archive_stays_until_its_import_is_over_and_no_longer(empty, uploads):
    data = packed(uploads[:1])
    begin_import(empty, data)
    task = claim_long(empty)
    with empty.store.database.read() as connection:
        [file] = files_of(connection, task.job.number).values()
    assert empty.store.blobs.holds(file.blob)
    assert file.bytes == empty.store.blobs.size(file.blob)
    assert empty.run(task) == JobState.SUCCEEDED
    assert not empty.store.blobs.holds(file.blob)
    job = begin_import(empty, data)  # the same archive again, which is damaged meanwhile
    task = claim_long(empty)
    empty.store.blobs.path(file.blob).write_bytes(b"no tar")
    assert empty.run(task) == JobState.FAILED
    assert "neither a zip nor a tar" in str(empty.get_job(job.job_id).error)
    assert not empty.store.blobs.holds(file.blob)


def test_nothing_is_left_of_an_archive_that_was_refused(empty, uploads):
    before = sorted(empty.store.blobs.digests())
    with pytest.raises(UnknownMap):
        begin_import(empty, packed(uploads[:1]), map_name="nowhere")
    with (  # noqa: PT012
        pytest.raises(OSError, match="gone"),
        empty.imports.receive("hall", ImportOptions()) as receiver,
    ):
        receiver.write(packed(uploads[:1])[:3000])
        raise ConnectionError("gone")
    assert sorted(empty.store.blobs.digests()) == before
    assert list(empty.settings.blob_dir.glob(".*")) == []


def test_a_cancelled_import_takes_no_frame_more(empty, uploads, monkeypatch):
    monkeypatch.setattr(archive_import, "_AT_ONCE", 2)
    job = begin_import(empty, packed(uploads[:4]))
    between = Between(lambda: cancel(empty.store, job.job_id))
    with pytest.raises(LostLease):
        empty.imports.handle(claim_long(empty), between)
    assert len(empty.list_frames("hall").items) == 2
    assert len(list(empty.store.blobs.digests())) == 2  # theirs; the archive is gone


def zeros(megabytes, name):
    """Return a compressed archive of a few kilobytes with a member of zeros."""
    made = io.BytesIO()
    with tarfile.open(fileobj=made, mode="w:gz", compresslevel=1) as archive:
        info = tarfile.TarInfo(f"{name}/0.png")
        info.size = megabytes << 20
        archive.addfile(info, io.BytesIO(bytes(info.size)))
    return made.getvalue()


QUOTA = 8 << 20


def test_archives_take_no_more_disk_than_the_quota_of_their_map(empty, uploads):
    """Archives of compressed zeros, sent one after another and all at once."""
    edit_map(empty.store, "hall", {"quota_bytes": QUOTA})
    most = QUOTA * 11 // 10
    job = begin_import(empty, zeros(5, "first"))
    assert QUOTA // 2 < bytes_on_disk(empty) <= most
    assert used(empty).bytes == bytes_on_disk(empty)
    for name in ("second", "third"):
        with pytest.raises(QuotaExceeded, match=rf"quota .*{QUOTA}|{QUOTA} .*quota"):
            begin_import(empty, zeros(5, name))
        assert bytes_on_disk(empty) <= most
    cancel(empty.store, job.job_id)
    assert (bytes_on_disk(empty), used(empty).bytes) == (0, 0)  # at once, without any upkeep
    with ExitStack() as open_ones:
        receivers = [
            open_ones.enter_context(empty.imports.receive("hall", ImportOptions()))
            for _ in range(3)
        ]
        refused = 0
        for i, receiver in enumerate(receivers):
            try:
                receiver.write(zeros(5, f"at-once-{i}"))
            except QuotaExceeded:
                refused += 1
            assert bytes_on_disk(empty) <= most
        assert refused == 2
        edit_map(empty.store, "hall", {"quota_bytes": bytes_on_disk(empty) + 10})
        with pytest.raises(QuotaExceeded):  # a frame does not get the room of an archive
            empty.add_frame("hall", uploads[0].data, uploads[0].meta)
        edit_map(empty.store, "hall", {"quota_bytes": QUOTA})
    assert (bytes_on_disk(empty), used(empty).bytes) == (0, 0)
    begin_import(empty, zeros(7, "last"))  # what was refused or not kept takes no room


def test_two_services_do_not_share_the_room_of_one_archive(empty, make_engine):
    """Neither sees what the other is receiving: the second import is refused when it begins."""
    edit_map(empty.store, "hall", {"quota_bytes": QUOTA})
    with ExitStack() as both:
        engines = (empty, make_engine())
        receivers = [
            both.enter_context(one.imports.receive("hall", ImportOptions())) for one in engines
        ]
        files = []
        for i, receiver in enumerate(receivers):
            receiver.write(zeros(5, f"service-{i}"))
            files.append(receiver.end())
        engines[0].imports.begin("hall", files[0], ImportOptions())
        with pytest.raises(QuotaExceeded):
            engines[1].imports.begin("hall", files[1], ImportOptions())
    assert used(empty).bytes == bytes_on_disk(empty) == files[0].bytes


def test_the_archive_of_an_import_whose_worker_died_goes_at_the_next_upkeep(
    empty, uploads, due_now, monkeypatch
):
    monkeypatch.setattr(archive_import, "TIDY_S", 0.0)
    job = begin_import(empty, packed(uploads[:1]))
    for _ in range(MAXIMUM_FAILURES):
        due_now(empty)
        token = claim_long(empty).job.token
        worker_died(empty.store, job.job_id, token, "killed", "", counts=True)
    assert empty.get_job(job.job_id).state == JobState.DEAD
    begin_import(empty, packed(uploads[1:3]))
    assert len(list(empty.store.blobs.digests())) == 2
    empty.publish_due()
    [left] = empty.store.blobs.digests()  # that of the import that waits
    assert used(empty).bytes == empty.store.blobs.size(left)
    empty.retry_job(job.job_id)
    states = {empty.run(claim_long(empty)), empty.run(claim_long(empty))}
    assert states == {JobState.FAILED, JobState.SUCCEEDED}
    assert "Send it again" in str(empty.get_job(job.job_id).error)


def test_an_archive_that_was_swept_before_its_job_was_there_is_not_acknowledged(empty, uploads):
    with empty.imports.receive("hall", ImportOptions()) as receiver:
        receiver.write(packed(uploads[:1]))
        archive = receiver.end()
    collect_blobs(empty.store, [archive.blob])  # an import of the same archive ends at this moment
    with pytest.raises(Conflict, match="Send the file again"):
        empty.imports.begin("hall", archive, ImportOptions())
    assert list(list_jobs(empty.store).items) == []
