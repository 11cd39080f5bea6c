"""Tests of the import of recordings: the same frames as those of an upload, once each."""

import os
import signal
import sys
from contextlib import closing
from types import SimpleNamespace

import numpy as np
import pytest
from pydantic import ValidationError

from sceneprint.decoders.recording_decoder import RecordingDecoder, RecordingIndex
from sceneprint.engine.ingest import recording_import
from sceneprint.engine.ingest.archive_import import add_block
from sceneprint.engine.jobs.lifecycle import cancel
from sceneprint.engine.jobs.tasks import LongJob
from sceneprint.errors import Busy, InvalidRequest, UnreadableArchive
from sceneprint.formats.recording.selection import RecordingOptions, recording_sequences
from sceneprint.store.maps import find_map
from sceneprint.store.queue import files_of
from sceneprint_client.api import JobState, NewMap
from sceneprint_client.api.frames import ImportOptions
from sceneprint_client.frame_files import meta_of

ROOM = 2.5  #: metres from the camera to the wall
FRAMES = 6


def wall(i):
    """Depth of a wall with steps, in millimetres."""
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
    with engine.imports.receive("hall", options) as receiver:
        receiver.write(path.read_bytes())
        file = receiver.end()
    return engine.imports.begin("hall", file, options)[0]


def run_import(engine):
    """Run the slices of the import, and no other job; return the state after each."""
    states = []
    while (work := engine.claim("test")) is not None:
        if isinstance(work, LongJob):
            states.append(engine.run(work))
    return states


def second_slice(engine):
    """Read the recording in the first slice, and return the job for the next one."""
    work = engine.claim("test")
    assert isinstance(work, LongJob)
    engine.run(work)
    work = engine.claim("test")
    assert isinstance(work, LongJob)
    return work


@pytest.fixture
def engine(make_engine):
    engine = make_engine()
    engine.create_map(NewMap(name="hall", model="depth"))
    return engine


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
    for one, other in zip(ours, theirs, strict=True):
        texts = [
            frame.model_dump_json(exclude=own).replace(frame.frame_id, "ID")
            for frame in (one, other)
        ]
        assert texts[0] == texts[1]


def test_the_outline_is_there_before_the_frames(engine, ros, tmp_path):
    job = begun(engine, write_drive(ros, tmp_path))
    work = engine.claim("test")
    assert isinstance(work, LongJob)
    assert engine.run(work) == JobState.QUEUED
    progress = engine.get_job(job.job_id).progress
    assert (progress.done, progress.total, progress.phase) == (0, FRAMES, "add")
    uses = {one.name: (one.count, one.use) for one in progress.recording.topics}
    assert uses == {
        "/camera/depth/image_raw": (FRAMES, "16UC1, used"),
        "/camera/depth/camera_info": (FRAMES, "camera"),
        "/tf": (FRAMES, ""),
        "/tf_static": (1, ""),
    }
    assert progress.recording.problem is None
    assert "mounting: at 0.210 -0.050 0.930 m in base_link" in progress.recording.findings


def test_topics_are_shown_if_none_can_be_chosen(engine, ros, tmp_path):
    def fill(writer):
        for name in ("/a", "/b"):
            writer.image(0, wall(0), topic=f"{name}/image_raw")
            writer.camera_info(0, f"{name}/camera_info")

    path = ros.write(tmp_path, fill, "mcap")
    job = begun(engine, path)
    assert run_import(engine) == [JobState.QUEUED, JobState.FAILED]
    failed = engine.get_job(job.job_id)
    assert failed.error == failed.progress.recording.problem
    assert str(failed.error).endswith(" messages). Select one with `topic`.")
    used = [one.name for one in failed.progress.recording.topics if one.use == "16UC1"]
    assert used == ["/a/image_raw", "/b/image_raw"]
    begun(engine, path, topic="/b/image_raw")
    assert run_import(engine)[-1] == JobState.SUCCEEDED
    [frame] = engine.list_frames("hall").items
    assert frame.name.startswith("b/image_raw/")


@pytest.mark.parametrize(
    ("more", "ends"), [
        ({"topic": "/none"}, "Select one of /a/image_raw (Image, 1 messages)."),
        ({}, "topics of CameraInfo are none. Select one with `camera_info`."),
    ],
)  # fmt: skip
def test_a_problem_advises_nothing_that_only_commands_can_do(engine, ros, tmp_path, more, ends):
    def fill(writer):
        writer.image(0, wall(0), topic="/a/image_raw")

    job = begun(engine, ros.write(tmp_path, fill, "mcap"), **more)
    run_import(engine)
    assert str(engine.get_job(job.job_id).error).endswith(ends)


def test_an_import_fails_at_once_without_rosbags(engine, ros, tmp_path, monkeypatch):
    job = begun(engine, write_drive(ros, tmp_path))
    monkeypatch.setitem(sys.modules, "rosbags", None)
    assert run_import(engine) == [JobState.FAILED]
    assert "pip install 'rosbags" in str(engine.get_job(job.job_id).error)


@pytest.mark.parametrize(
    "sent", [signal.SIGKILL, pytest.param(signal.SIGSTOP, marks=pytest.mark.thorough)]
)
def test_only_the_frame_whose_process_fails_is_refused(ros, tmp_path, sent):
    path, options = write_drive(ros, tmp_path), ImportOptions.model_validate({"as": "recording"})
    with path.open("rb") as file, closing(RecordingDecoder(file.fileno(), path.name, 3)) as decoder:
        text, index = decoder.outline(options)
        assert RecordingIndex.parse(text).frames == index.frames
        assert index.topic is not None
        first, second = (decoder.frame(index.topic, one["place"]) for one in index.frames[:2])
        os.kill(decoder._process.pid, sent)
        with pytest.raises(UnreadableArchive):
            decoder.frame(index.topic, index.frames[0]["place"])
        assert decoder.frame(index.topic, index.frames[1]["place"]) == second != first


def test_a_slice_is_repeated_if_no_process_can_read_a_frame(engine, ros, tmp_path):
    def read():
        raise Busy("No process can be started.")

    begun(engine, write_drive(ros, tmp_path))
    work = engine.claim("test")
    assert isinstance(work, LongJob)
    with pytest.raises(Busy):
        add_block(engine.uploads, work, [("a", read)])


@pytest.mark.parametrize(("seconds", "looks"), [(1, 1), (8, FRAMES - 1)])
def test_blocks_of_slow_frames_are_smaller(engine, ros, tmp_path, monkeypatch, seconds, looks):
    begun(engine, write_drive(ros, tmp_path))
    work = second_slice(engine)
    clock = SimpleNamespace(monotonic=iter(range(0, 1000, seconds)).__next__)
    monkeypatch.setattr(recording_import, "time", clock)
    counted = list[bool]()

    def is_over():
        counted.append(False)
        return False

    assert engine.jobs.handlers["import-bag"](work, is_over).over
    assert len(counted) == looks


def test_a_slice_that_is_run_again_adds_no_frame_twice(engine, ros, tmp_path):
    begun(engine, write_drive(ros, tmp_path))
    work = second_slice(engine)
    first = engine.jobs.handlers["import-bag"](work, lambda: True)  # its worker dies
    assert (first.over, first.progress["done"]) == (False, 1)
    assert engine.run(work) == JobState.SUCCEEDED
    assert len(engine.list_frames("hall").items) == FRAMES
    done = engine.get_job(work.job.id).result
    assert (done["received"], done["there"]) == (FRAMES - 1, 1)


def test_files_and_their_bytes_go_with_a_cancelled_import(engine, ros, tmp_path):
    path = write_drive(ros, tmp_path)
    job = begun(engine, path)
    work = engine.claim("test")
    assert isinstance(work, LongJob)
    engine.run(work)

    def stored():
        with engine.store.database.read() as connection:
            names = list(files_of(connection, work.job.number))
            return names, find_map(connection, "hall").used_bytes

    assert stored() == (["archive", "index"], path.stat().st_size)
    cancel(engine.store, job.job_id)
    assert stored() == ([], 0)


def test_damage_is_the_fault_of_the_file(engine, ros, tmp_path):
    path = write_drive(ros, tmp_path)
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(path.read_bytes()[:-200])
    job = begun(engine, cut)
    assert run_import(engine) == [JobState.FAILED]
    assert "mcap recover" in str(engine.get_job(job.job_id).error)
    with pytest.raises(UnreadableArchive, match=r"notes\.txt"):
        begun(engine, _written(tmp_path / "notes.txt", b"no recording" * 1000))


def _written(path, data):
    path.write_bytes(data)
    return path


@pytest.mark.parametrize(
    "more", [{"as": "frames", "topic": "/a"}, {"as": "map", "keyframe_m": 1.0},
             {"as": "recording", "heights": [1.0]}],
)  # fmt: skip
def test_options_of_other_imports_are_refused(more):
    with pytest.raises((ValidationError, InvalidRequest)):
        ImportOptions.model_validate(more)
