"""Tests of imports of archives and recordings, which continue after their last stored slice."""

import io
import json
import os
import signal
import sys
import tarfile
from contextlib import ExitStack, closing

import numpy as np
import pytest

from sceneprint.decoders.recording_decoder import RecordingDecoder, RecordingIndex
from sceneprint.engine.ingest import archive_import
from sceneprint.engine.jobs.lifecycle import cancel, list_jobs, worker_died
from sceneprint.engine.jobs.tasks import LongJob
from sceneprint.engine.maps.map_lifecycle import edit_map
from sceneprint.engine.upkeep.garbage_collection import collect_blobs
from sceneprint.errors import Conflict, LostLease, QuotaExceeded, UnknownMap, UnreadableArchive
from sceneprint.formats.recording.selection import RecordingOptions, recording_sequences
from sceneprint.store.queue import MAXIMUM_FAILURES, files_of
from sceneprint_client.api import JobState, NewMap
from sceneprint_client.api.frames import ImportOptions, UploadSummary, pooled_range
from sceneprint_client.frame_files import meta_of
from tests.engine.conftest import begin_import, bytes_on_disk, claim_long, used


def packed(uploads):
    buffer = io.BytesIO()
    camera = uploads[0].meta.intrinsics.model_dump(exclude={"distortion"})
    with tarfile.open(fileobj=buffer, mode="w:gz") as archive:
        members = {"run/intrinsics.json": json.dumps(camera).encode()}
        members |= {f"run/{i}.png": upload.data for i, upload in enumerate(uploads)}
        for name, data in members.items():
            info = tarfile.TarInfo(name)
            info.size = len(data)
            archive.addfile(info, io.BytesIO(data))
    return buffer.getvalue()


def test_a_slice_that_was_lost_is_done_again(empty, uploads, monkeypatch):
    monkeypatch.setattr(archive_import, "_AT_ONCE", 2)
    job = begin_import(empty, packed(uploads[:5]))
    task = claim_long(empty)
    # at least some are taken, so that it comes to an end
    lost = empty.imports.handle(task, lambda: True)  # and is never stored: its worker died
    assert [item["status"] for item in lost.items] == [202, 202]
    assert lost.progress["done"] == 2
    assert list(empty.imports.items("hall", job.job_id).items) == []
    again = empty.imports.handle(task, lambda: True)
    assert [item["status"] for item in again.items] == [200, 200]
    assert [item["frame_id"] for item in again.items] == [item["frame_id"] for item in lost.items]
    assert empty.run(task) == JobState.SUCCEEDED  # there is time for all now
    result = empty.get_job(job.job_id)
    summary = UploadSummary.model_validate(result.result.pop("summary"))
    counted = {"sequences": 1, "received": 3, "there": 2, "refused": 0, "ignored": 0}
    assert result.result == counted
    assert (summary.frames, summary.poses, summary.lost) == (5, 0, 0)
    assert list(summary.without_pose.values()) == [5]
    page = empty.imports.items("hall", job.job_id, limit=3)
    rest = empty.imports.items("hall", job.job_id, page.next_cursor, 3)
    items = [*page.items, *rest.items]
    assert [item.name for item in items] == [f"run/{i}.png" for i in range(5)]
    assert rest.next_cursor is None
    assert summary.depth == pooled_range(item.samples for item in items)
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

    def is_over():
        cancel(empty.store, job.job_id)
        return False

    with pytest.raises(LostLease):
        empty.imports.handle(claim_long(empty), is_over)
    assert len(empty.list_frames("hall").items) == 2
    assert len(list(empty.store.blobs.digests())) == 2  # theirs; the archive is gone


def zeros(megabytes, name):
    """Return a compressed archive of a few kilobytes with a member of zeros."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:gz", compresslevel=1) as archive:
        info = tarfile.TarInfo(f"{name}/0.png")
        info.size = megabytes << 20
        archive.addfile(info, io.BytesIO(bytes(info.size)))
    return buffer.getvalue()


QUOTA = 8 << 20


def test_archives_take_no_more_disk_than_the_quota_of_their_map(empty, uploads):
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
            empty.add(uploads[0])
        edit_map(empty.store, "hall", {"quota_bytes": QUOTA})
    assert (bytes_on_disk(empty), used(empty).bytes) == (0, 0)
    begin_import(empty, zeros(7, "last"))  # what was refused or not kept takes no room


def test_two_services_do_not_share_the_room_of_one_archive(empty, make_engine):
    edit_map(empty.store, "hall", {"quota_bytes": QUOTA})
    with ExitStack() as both:
        engines = (empty, make_engine())
        receivers = [
            both.enter_context(e.imports.receive("hall", ImportOptions())) for e in engines
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
    empty, uploads, monkeypatch
):
    monkeypatch.setattr(archive_import, "TIDY_S", 0.0)
    job = begin_import(empty, packed(uploads[:1]))
    for _ in range(MAXIMUM_FAILURES):
        empty.make_due()
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


ROOM = 2.5  #: metres from the camera to the wall
FRAMES = 6


def wall(i):
    rows, columns = np.mgrid[:60, :80]
    samples = 1000 * ROOM + 40 * ((rows // 12 + columns // 16 + i) % 7)
    return samples.astype(np.uint16)


def write_drive(ros, folder, container="mcap", **more):
    """Write a recording with an image every half metre, and return its path."""

    def fill(writer):
        writer.transforms(0, {("base_link", "camera"): ros.camera}, "/tf_static")
        for i in range(FRAMES):
            writer.transforms(i, {("odom", "base_link"): ros.transform(0.5 * i, 0, 0)})
            writer.camera_info(i)
            writer.image(i, wall(i), **more)

    return ros.write(folder, fill, container)


def begun(engine, path, **more):
    options = ImportOptions.model_validate({"as": "recording", "name": path.name, **more})
    return begin_import(engine, path.read_bytes(), options)


def run_import(engine):
    """Run the slices of the import, and no other job; return the state after each."""
    states = []
    while (work := engine.claim("test")) is not None:
        if isinstance(work, LongJob):
            states.append(engine.run(work))
    return states


def second_slice(engine):
    """Read the recording in the first slice, and return the job for the next one."""
    engine.run(claim_long(engine))
    return claim_long(engine)


@pytest.fixture
def engine(empty):
    return empty


@pytest.mark.parametrize("container", ["mcap", pytest.param("ros1", marks=pytest.mark.thorough)])
def test_frames_are_those_of_an_upload(engine, ros, tmp_path, container):
    path = write_drive(ros, tmp_path, container)
    job = begun(engine, path, robot="r1", tags=["seen"])
    assert run_import(engine) == [JobState.QUEUED, JobState.SUCCEEDED]
    done = engine.get_job(job.job_id)
    assert (done.result["received"], done.result["refused"]) == (FRAMES, 0)
    assert done.result["summary"]["poses"] == FRAMES
    engine.create_map(NewMap(name="sent", model="depth"))
    [sequence] = recording_sequences(path, RecordingOptions())
    for reference in sequence.frames:
        meta = meta_of(
            reference, robot="r1", session=sequence.name, tags=["seen"],
            parent_frame=f"r1/{sequence.parent_frame}",
        )  # fmt: skip
        engine.add_frame("sent", reference.read_bytes(), meta)
    ours, theirs = (
        sorted(engine.list_frames(name).items, key=lambda one: one.sequence or 0)
        for name in ("hall", "sent")
    )
    assert len(ours) == FRAMES
    own = {"map", "frame_id", "job_id", "state", "received_at", "created_at", "etag"}
    for row, other in zip(ours, theirs, strict=True):
        texts = [
            frame.model_dump_json(exclude=own).replace(frame.frame_id, "ID")
            for frame in (row, other)
        ]
        assert texts[0] == texts[1]


def test_an_import_fails_at_once_without_rosbags(engine, ros, tmp_path, monkeypatch):
    job = begun(engine, write_drive(ros, tmp_path))
    monkeypatch.setitem(sys.modules, "rosbags", None)
    assert run_import(engine) == [JobState.FAILED]
    assert "pip install 'rosbags" in str(engine.get_job(job.job_id).error)


def test_a_process_that_ends_is_replaced(ros, tmp_path):
    path, options = write_drive(ros, tmp_path), ImportOptions.model_validate({"as": "recording"})
    with path.open("rb") as file, closing(RecordingDecoder(file.fileno(), path.name, 3)) as decoder:
        text, index = decoder.outline(options)
        assert RecordingIndex.parse(text).frames == index.frames
        first, second = (decoder.frame(index.topic, frame["place"]) for frame in index.frames[:2])
        os.kill(decoder._decoder.process.pid, signal.SIGKILL)
        assert decoder.frame(index.topic, index.frames[1]["place"]) == second != first


def test_a_slice_that_is_run_again_adds_no_frame_twice(engine, ros, tmp_path):
    begun(engine, write_drive(ros, tmp_path))
    work = second_slice(engine)
    first = engine.jobs.handlers["import-bag"](work, lambda: True)  # its worker dies
    assert (first.over, first.progress["done"]) == (False, 1)
    assert engine.run(work) == JobState.SUCCEEDED
    assert len(engine.list_frames("hall").items) == FRAMES
    done = engine.get_job(work.job.id).result
    assert (done["received"], done["there"]) == (FRAMES - 1, 1)


def test_damage_is_the_fault_of_the_file(engine, ros, tmp_path):
    path = write_drive(ros, tmp_path)
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(path.read_bytes()[:-200])
    job = begun(engine, cut)
    assert run_import(engine) == [JobState.FAILED]
    assert "mcap recover" in str(engine.get_job(job.job_id).error)
    notes = tmp_path / "notes.txt"
    notes.write_bytes(b"no recording" * 1000)
    with pytest.raises(UnreadableArchive, match=r"notes\.txt"):
        begun(engine, notes)
