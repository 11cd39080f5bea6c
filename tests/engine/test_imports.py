"""Tests that an import continues after its last stored slice."""

import io
import json
import os
import tarfile
from contextlib import ExitStack
from pathlib import Path

import pytest

from sceneprint.engine.ingest import archive_import
from sceneprint.engine.ingest import uploads as uploading
from sceneprint.engine.jobs.lifecycle import cancel, list_jobs, worker_died
from sceneprint.engine.jobs.tasks import LongJob
from sceneprint.engine.maps.map_lifecycle import edit_map
from sceneprint.engine.upkeep.garbage_collection import collect_blobs
from sceneprint.errors import Conflict, LostLease, QuotaExceeded, UnknownMap
from sceneprint.formats.archive import Archive
from sceneprint.store.blobs.folder import MARK
from sceneprint.store.maps import MapUsage, counted_usage, find_map
from sceneprint.store.queue import MAXIMUM_FAILURES, files_of
from sceneprint_client.api import JobState, NewMap
from sceneprint_client.api.frames import ImportOptions, UploadSummary, pooled_range
from tests.engine.conftest import Between


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


def begun(engine, data, map_name="hall"):
    with engine.imports.receive(map_name, ImportOptions()) as receiver:
        receiver.write(data)
        archive = receiver.end()
    return engine.imports.begin(map_name, archive, ImportOptions())[0]


def claimed(engine):
    while True:  # frames that wait to be signed are left waiting
        work = engine.claim("test")
        if isinstance(work, LongJob):
            return work
        assert work is not None


def test_a_slice_that_was_lost_is_done_again(empty, uploads, monkeypatch):
    monkeypatch.setattr(archive_import, "_AT_ONCE", 2)
    job = begun(empty, packed(uploads[:5]))
    task = claimed(empty)
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


def test_large_frames_are_not_in_memory_together(empty, uploads, monkeypatch):
    """Sixteen clouds of 512 MiB each would be more than a worker may take."""
    sizes = [len(one.data) for one in uploads[:3]]
    begun(empty, packed(uploads[:3]))
    task = claimed(empty)
    taken = []
    for most in (max(sizes) - 1, sizes[0] + sizes[1], sum(sizes)):
        monkeypatch.setattr(archive_import, "_BYTES_AT_ONCE", most)
        taken.append(len(empty.imports.handle(task, lambda: True).items))
    assert taken == [1, 2, 3]


def test_an_archive_stays_until_its_import_is_over_and_no_longer(empty, uploads):
    data = packed(uploads[:1])
    begun(empty, data)
    task = claimed(empty)
    with empty.store.database.read() as connection:
        [file] = files_of(connection, task.job.number).values()
    assert empty.store.blobs.holds(file.blob)
    assert file.bytes == empty.store.blobs.size(file.blob)
    assert empty.run(task) == JobState.SUCCEEDED
    assert not empty.store.blobs.holds(file.blob)
    job = begun(empty, data)  # the same archive again, which is damaged meanwhile
    task = claimed(empty)
    empty.store.blobs.path(file.blob).write_bytes(b"no tar")
    assert empty.run(task) == JobState.FAILED
    assert "neither a zip nor a tar" in str(empty.get_job(job.job_id).error)
    assert not empty.store.blobs.holds(file.blob)


def test_nothing_is_left_of_an_archive_that_was_refused(empty, uploads):
    before = sorted(empty.store.blobs.digests())
    with pytest.raises(UnknownMap):
        begun(empty, packed(uploads[:1]), "nowhere")
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
    job = begun(empty, packed(uploads[:4]))
    between = Between(lambda: cancel(empty.store, job.job_id))
    with pytest.raises(LostLease):
        empty.imports.handle(claimed(empty), between)
    assert len(empty.list_frames("hall").items) == 2
    assert len(list(empty.store.blobs.digests())) == 2  # theirs; the archive is gone


def test_a_map_that_is_made_anew_takes_nothing_of_an_import_into_the_one_before(
    empty, uploads, monkeypatch
):
    monkeypatch.setattr(archive_import, "_AT_ONCE", 2)
    begun(empty, packed(uploads[:4]))

    def make_anew():
        empty.delete_map("hall")
        empty.create_map(NewMap(name="hall", model="depth"))

    between = Between(make_anew)
    with pytest.raises(LostLease):
        empty.imports.handle(claimed(empty), between)
    assert list(empty.list_frames("hall").items) == []
    assert list(empty.store.blobs.digests()) == []


def zeros(megabytes, name):
    """Return a compressed archive of a few kilobytes with a member of zeros."""
    made = io.BytesIO()
    with tarfile.open(fileobj=made, mode="w:gz", compresslevel=1) as archive:
        info = tarfile.TarInfo(f"{name}/0.png")
        info.size = megabytes << 20
        archive.addfile(info, io.BytesIO(bytes(info.size)))
    return made.getvalue()


def bytes_on_disk(engine):
    """Return the size of all files below the folder of blobs, unfinished ones too."""
    return sum(
        os.lstat(Path(folder, name)).st_size
        for folder, _, names in os.walk(engine.settings.blob_dir)
        for name in names
        if name != MARK  # it says whose the blobs are
    )


def counted(engine, map_name="hall"):
    """Return the bytes that a map is counted to hold, which a count over its rows confirms."""
    with engine.store.database.read() as connection:
        row = find_map(connection, map_name)
        assert counted_usage(connection, row.number) == MapUsage(row.used_frames, row.used_bytes)
    return row.used_bytes


QUOTA = 8 << 20


def test_archives_take_no_more_disk_than_the_quota_of_their_map(empty, uploads):
    """Archives of compressed zeros, sent one after another and all at once."""
    edit_map(empty.store, "hall", {"quota_bytes": QUOTA})
    most = QUOTA * 11 // 10
    job = begun(empty, zeros(5, "first"))
    assert QUOTA // 2 < bytes_on_disk(empty) <= most
    assert counted(empty) == bytes_on_disk(empty)
    for name in ("second", "third"):
        with pytest.raises(QuotaExceeded, match=rf"quota .*{QUOTA}|{QUOTA} .*quota"):
            begun(empty, zeros(5, name))
        assert bytes_on_disk(empty) <= most
    cancel(empty.store, job.job_id)
    assert (bytes_on_disk(empty), counted(empty)) == (0, 0)  # at once, without any upkeep
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
    assert (bytes_on_disk(empty), counted(empty)) == (0, 0)
    begun(empty, zeros(7, "last"))  # what was refused or not kept takes no room


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
    assert counted(empty) == bytes_on_disk(empty) == files[0].bytes


def test_an_archive_counts_until_its_import_is_over(empty, uploads):
    edit_map(empty.store, "hall", {"quota_bytes": QUOTA})
    begun(empty, packed(uploads[:2]))
    [archive] = empty.store.blobs.digests()
    size = empty.store.blobs.size(archive)
    assert counted(empty) == size
    assert empty.run(claimed(empty)) == JobState.SUCCEEDED
    assert counted(empty) == sum(len(one.data) for one in uploads[:2]) == bytes_on_disk(empty)
    begun(empty, packed(uploads[2:4]))
    empty.delete_map("hall")
    assert bytes_on_disk(empty) == 0


def test_the_archive_of_an_import_whose_worker_died_goes_at_the_next_upkeep(
    empty, uploads, due_now, monkeypatch
):
    monkeypatch.setattr(archive_import, "TIDY_S", 0.0)
    job = begun(empty, packed(uploads[:1]))
    for _ in range(MAXIMUM_FAILURES):
        due_now(empty)
        token = claimed(empty).job.token
        worker_died(empty.store, job.job_id, token, "killed", "", counts=True)
    assert empty.get_job(job.job_id).state == JobState.DEAD
    begun(empty, packed(uploads[1:3]))
    assert len(list(empty.store.blobs.digests())) == 2
    empty.publish_due()
    [left] = empty.store.blobs.digests()  # that of the import that waits
    assert counted(empty) == empty.store.blobs.size(left)
    empty.retry_job(job.job_id)
    states = {empty.run(claimed(empty)), empty.run(claimed(empty))}
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


def test_a_frame_that_memory_does_not_do_for_costs_no_other(empty, uploads, monkeypatch):
    """One that cannot be read out of the archive, and one that cannot be decoded beside others."""
    read, decode, asked = Archive.data_of, uploading.read_upload, []

    def data_of(archive, reference):
        if archive.name_of(reference) == "run/0.png":
            raise MemoryError
        return read(archive, reference)

    def decoded(data, meta, decoders):
        asked.append(data)
        if data == uploads[2].data:
            raise MemoryError
        return decode(data, meta, decoders)

    monkeypatch.setattr(Archive, "data_of", data_of)
    monkeypatch.setattr(uploading, "read_upload", decoded)
    job = begun(empty, packed(uploads[:4]))
    assert empty.run(claimed(empty)) == JobState.SUCCEEDED
    items = empty.imports.items("hall", job.job_id).items
    assert [one.status for one in items] == [422, 202, 422, 202]
    assert len(asked) == 5  # two of three together, then each alone
    for refused in (items[0], items[2]):
        assert "needs more memory than a worker may use" in refused.problem.detail
    assert len(empty.list_frames("hall").items) == 2
