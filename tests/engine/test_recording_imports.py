"""Tests of the import of recordings: the same frames as those of an upload, once each."""

import os
import signal
import sys
from contextlib import closing

import numpy as np
import pytest

from sceneprint.decoders.recording_decoder import RecordingDecoder, RecordingIndex
from sceneprint.engine.jobs.tasks import LongJob
from sceneprint.errors import UnreadableArchive
from sceneprint.formats.recording.selection import RecordingOptions, recording_sequences
from sceneprint_client.api import JobState, NewMap
from sceneprint_client.api.frames import ImportOptions
from sceneprint_client.frame_files import meta_of
from tests.engine.conftest import begin_import, claim_long

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
    work = claim_long(engine)
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
