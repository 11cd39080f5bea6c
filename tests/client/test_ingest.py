"""Tests of uploads under an id, of batches and of archives through the client."""

import io
import tarfile

import numpy as np
import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.errors import (
    FrameConflict,
    InvalidRequest,
    UnknownMap,
    UnreadableCloud,
)
from sceneprint_client import meta_of
from sceneprint_client.api import JobState
from sceneprint_client.api.base import GivenBase
from sceneprint_client.api.frames import ImportOptions, MapImportResult

BASE = GivenBase.model_validate(
    {
        "base_frame": "base",
        "translation": {"x": 0.0, "y": 0.1, "z": 0.5},
        "rotation": {"x": 0.5, "y": -0.5, "z": 0.5, "w": -0.5},
    }
)


@pytest.fixture(scope="session")
def rooms(references):
    """The folder that all references lie below."""
    return references[0].path.parent.parent.parent


def packed(rooms, **more):
    """A compressed tar of the folder, with more members of these names."""
    made = io.BytesIO()
    with tarfile.open(fileobj=made, mode="w:gz") as archive:
        archive.add(rooms, ".")
        for name, data in more.items():
            info = tarfile.TarInfo(name.replace("__", "/") + ".png")
            info.size = len(data)
            archive.addfile(info, io.BytesIO(data))
    made.seek(0)
    return made


def done(client, map_name, archive, options=None):
    """What came of an import, when it and all its frames are done."""
    job = client.import_archive(map_name, archive, options)
    assert (job.kind, job.map, job.state.over) == ("import", map_name, False)
    [over] = client.wait([job.job_id], timeout_s=PATIENCE_S)
    items = list(client.import_items(map_name, job.job_id))
    client.wait([one.job_id for one in items if one.job_id is not None], timeout_s=PATIENCE_S)
    return over, items


def test_a_frame_put_under_an_id(client, map_name, references):
    client.create_map(map_name, model="depth")
    meta = meta_of(references[0], base=BASE)
    added = client.put_frame(map_name, "a.0-1_b", references[0], meta, wait_s=PATIENCE_S)
    assert (added.frame_id, added.state) == ("a.0-1_b", "indexed")
    assert client.put_frame(map_name, "a.0-1_b", references[0], meta) == added
    frame = client.frame(map_name, "a.0-1_b")
    assert frame.base_frame == "base"
    assert frame.T_base_sensor.matrix == [  # of the quaternion, by hand
        [0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.1], [0.0, -1.0, 0.0, 0.5], [0.0, 0.0, 0.0, 1.0],
    ]  # fmt: skip
    with pytest.raises(FrameConflict, match="different base_frame, T_base_sensor"):
        client.put_frame(map_name, "a.0-1_b", references[0])
    with pytest.raises(InvalidRequest, match="frame id"):
        client.put_frame(map_name, "../x", references[0])
    with pytest.raises(UnknownMap):
        client.put_frame("nowhere", "a", references[0])
    client.delete_frame(map_name, "a.0-1_b")


def test_a_batch(client, map_name, references):
    client.create_map(map_name, model="depth")
    known = [meta_of(one) for one in references]
    sent = [references[0], b"none", references[1].path, references[0]]
    items = client.upload_batch(map_name, sent, [known[0], known[0], known[1], known[0]])
    assert [one.status for one in items] == [202, 422, 202, 200]
    assert items[1].problem.type == "/problems/unreadable-frame"
    assert client.frame(map_name, items[0].frame.frame_id).session == known[0].session
    assert [one.status for one in client.upload_batch(map_name, [references[1]])] == [200]
    with pytest.raises(InvalidRequest, match="has 0 frames"):
        client.upload_batch(map_name, [])
    with pytest.raises(InvalidRequest, match="for each"):
        client.upload_batch(map_name, [b"x", b"y"], known[:1])


def test_an_archive_gives_what_an_upload_of_the_folder_gives(client, map_name, rooms, references):
    client.create_map(map_name, model="depth")
    options = ImportOptions(robot="r1", tags=["x,y"], T_base_sensor=BASE, name="rooms")
    extra = {"room-0__seq-01__frame-000900.depth": b"none", "..__up": b"x"}
    job, items = done(client, map_name, packed(rooms, **extra), options)
    assert (job.state, job.error) == (JobState.SUCCEEDED, None)
    total = len(references) + 2
    assert (job.progress.done, job.progress.total) == (total, total)
    assert {name: job.result[name] for name in ("received", "there", "refused")} == {
        "received": len(references), "there": 0, "refused": 2,
    }  # fmt: skip
    assert [one.status for one in items].count(202) == len(references)
    assert {one.name: one.problem.type for one in items if one.problem is not None} == {
        "../up.png": "/problems/unreadable-archive",
        "room-0/seq-01/frame-000900.depth.png": "/problems/unreadable-frame",
    }
    frames = {one.frame_id: one for one in client.frames(map_name)}
    named = {one.name: frames[one.frame_id] for one in items if one.frame_id is not None}
    for reference in references:
        frame = named[f"./{reference.path.relative_to(rooms)}"]
        place = reference.path.parent.relative_to(rooms).as_posix()
        assert (frame.state, frame.robot, frame.tags) == ("indexed", "r1", ["x,y"])
        assert (frame.session, frame.base_frame) == (place, "base")
        assert frame.bytes == reference.path.stat().st_size
        assert reference.pose is not None
        assert frame.pose.parent_frame == f"r1/{place.partition('/')[0]}"
        assert np.allclose(frame.pose.matrix, reference.pose, atol=1e-12)
    again, items = done(client, map_name, packed(rooms), options)
    assert again.result["there"] == len(references)
    assert {one.status for one in items} == {200}


@pytest.mark.thorough
def test_a_map_that_is_one_file(client, map_name, room_mesh, tmp_path):
    client.create_map(map_name, model="depth")
    file = tmp_path / "room.ply"
    file.write_bytes(room_mesh)
    camera = {"fx": 73, "fy": 73, "cx": 39.5, "cy": 29.5, "width": 80, "height": 60}
    options = ImportOptions.model_validate(
        {"as": "map", "name": "room.ply", "camera": camera, "heights": [1.2], "session": "given"}
    )
    job = client.import_map(map_name, file, options)
    assert (job.kind, job.map) == ("import-map", map_name)
    [over] = client.wait([job.job_id], timeout_s=PATIENCE_S)
    assert (over.state, over.error) == (JobState.SUCCEEDED, None)
    result = MapImportResult.model_validate(over.result)
    frames = [one for one in client.frames(map_name) if one.state == "indexed"]
    assert len(frames) == result.views > 0
    assert {(one.session, *one.tags) for one in frames} == {("given", "virtual")}
    assert len(list(client.import_items(map_name, job.job_id))) == over.progress.views
    with pytest.raises(InvalidRequest, match="`as` = `map`"):
        client.import_map(map_name, file, ImportOptions())
    with pytest.raises(UnreadableCloud, match="cannot be read"):
        client.import_map(map_name, tmp_path / "none.ply")
    with pytest.raises(UnreadableCloud):
        client.import_map(map_name, io.BytesIO(b"no map"))
