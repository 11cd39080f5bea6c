"""Tests of uploads under an id, of batches and of archives through the client."""

import io
import tarfile

import numpy as np
import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.errors import FrameConflict, InvalidRequest
from sceneprint_client import meta_of
from sceneprint_client.api import JobState
from sceneprint_client.api.base import GivenBase
from sceneprint_client.api.frames import ImportOptions

BASE = GivenBase.model_validate(
    {
        "base_frame": "base",
        "translation": {"x": 0.0, "y": 0.1, "z": 0.5},
        "rotation": {"x": 0.5, "y": -0.5, "z": 0.5, "w": -0.5},
    }
)


@pytest.fixture(scope="session")
def rooms(references):
    return references[0].path.parent.parent.parent


def packed(rooms, **more):
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:gz") as archive:
        archive.add(rooms, ".")
        for name, data in more.items():
            info = tarfile.TarInfo(name.replace("__", "/") + ".png")
            info.size = len(data)
            archive.addfile(info, io.BytesIO(data))
    buffer.seek(0)
    return buffer


def done(client, map_name, archive, options=None):
    job = client.import_archive(map_name, archive, options)
    assert (job.kind, job.map, job.state.over) == ("import", map_name, False)
    [over] = client.wait([job.job_id], timeout_s=PATIENCE_S)
    items = list(client.import_items(map_name, job.job_id))
    client.wait([item.job_id for item in items if item.job_id is not None], timeout_s=PATIENCE_S)
    return over, items


def test_a_frame_put_under_an_id(client, map_name, references):
    client.create_map(map_name, model="depth")
    meta = meta_of(references[0], base=BASE)
    added = client.put_frame(map_name, "a.0-1_b", references[0], meta, wait_s=PATIENCE_S)
    assert (added.frame_id, added.state) == ("a.0-1_b", "indexed")
    frame = client.frame(map_name, "a.0-1_b")
    assert frame.base_frame == "base"
    assert frame.T_base_sensor.matrix == [  # of the quaternion, by hand
        [0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.1], [0.0, -1.0, 0.0, 0.5], [0.0, 0.0, 0.0, 1.0],
    ]  # fmt: skip
    with pytest.raises(FrameConflict, match="different base_frame, T_base_sensor"):
        client.put_frame(map_name, "a.0-1_b", references[0])
    with pytest.raises(InvalidRequest, match="frame id"):
        client.put_frame(map_name, "../x", references[0])


def test_a_batch(client, map_name, references):
    client.create_map(map_name, model="depth")
    sent, known = [references[0], b"none", references[0]], [meta_of(references[0])] * 3
    items = client.upload_batch(map_name, sent, known)
    assert [item.status for item in items] == [202, 422, 200]
    with pytest.raises(InvalidRequest, match="has 0 frames"):
        client.upload_batch(map_name, [])
    with pytest.raises(InvalidRequest, match="for each"):
        client.upload_batch(map_name, sent, known[:1])


def test_an_archive_gives_what_an_upload_of_the_folder_gives(client, map_name, rooms, references):
    client.create_map(map_name, model="depth")
    options = ImportOptions(robot="r1", tags=["x,y"], T_base_sensor=BASE, name="rooms")
    extra = {"room-0__seq-01__frame-000900.depth": b"none", "..__up": b"x"}
    job, items = done(client, map_name, packed(rooms, **extra), options)
    assert (job.state, job.error) == (JobState.SUCCEEDED, None)
    assert (job.result["received"], job.result["refused"]) == (len(references), 2)
    assert {item.name: item.problem.type for item in items if item.problem is not None} == {
        "../up.png": "/problems/unreadable-archive",
        "room-0/seq-01/frame-000900.depth.png": "/problems/unreadable-frame",
    }
    frames = {frame.frame_id: frame for frame in client.frames(map_name)}
    named = {item.name: frames[item.frame_id] for item in items if item.frame_id is not None}
    for reference in references:
        frame = named[f"./{reference.path.relative_to(rooms)}"]
        place = reference.path.parent.relative_to(rooms).as_posix()
        assert (frame.state, frame.robot, frame.tags) == ("indexed", "r1", ["x,y"])
        assert (frame.session, frame.base_frame) == (place, "base")
        assert frame.pose.parent_frame == f"r1/{place.partition('/')[0]}"
        assert np.allclose(frame.pose.matrix, reference.pose, atol=1e-12)
    again, items = done(client, map_name, packed(rooms), options)
    assert again.result["there"] == len(references)
