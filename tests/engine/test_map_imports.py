"""Tests of maps from a mesh: each view becomes a frame once, even after interruptions."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from sceneprint.engine.ingest import map_import
from sceneprint.engine.ingest.map_import import StoredSurface, weak_areas
from sceneprint.engine.jobs.lifecycle import cancel
from sceneprint.engine.jobs.tasks import LongJob
from sceneprint.engine.maps.map_lifecycle import edit_map
from sceneprint.engine.search.query import localization_of
from sceneprint.errors import InvalidRequest, QuotaExceeded, UnreadableCloud
from sceneprint.settings import Settings
from sceneprint.types import ReferenceSurface
from sceneprint_client.api import FrameState, JobState, NewMap, Query
from sceneprint_client.api.frames import ImportOptions, MapImportResult
from sceneprint_lab.synth.rooms import make_room
from tests.engine.conftest import begin_import, claim_long
from tests.whole_engine import Engine

#: A camera of few pixels, so that views are rendered and signed quickly.
CAMERA = {"fx": 73.0, "fy": 73.0, "cx": 39.5, "cy": 29.5, "width": 80, "height": 60}


def options_of(**more):
    usual = {"as": "map", "name": "room.ply", "up": "z", "camera": CAMERA, "heights": [1.0]}
    return ImportOptions.model_validate({**usual, **more})


def begun(engine, data, **more):
    return begin_import(engine, data, options_of(**more))


def slice_of(engine, task, is_over):
    return engine.jobs.handlers["import-map"](task, is_over)


def used_bytes(engine):
    return engine.row("hall").used_bytes


@pytest.fixture(scope="session")
def chosen_folder(once, room_mesh):
    """A data folder in which the import of a room has its viewpoints, and no view yet. Only to be
    copied.
    """

    def make(folder):
        with Engine(Settings(data_dir=folder)) as engine:
            engine.create_map(NewMap(name="hall", model="depth"))
            begun(engine, room_mesh, tags=["given"], robot="r1")
            for _ in ("read", "choose"):
                assert engine.run(claim_long(engine)) == JobState.QUEUED

    return once("chosen", make)


@pytest.fixture
def chosen(chosen_folder, tmp_path, make_engine):
    shutil.copytree(chosen_folder, tmp_path / "data")
    return make_engine()


def test_a_room_becomes_a_map_in_which_it_is_found(chosen):
    phases, state = list[str](), None
    while state != JobState.SUCCEEDED:
        work = chosen.claim("test")
        if work is None:  # the import waits for the last views to be signed
            chosen.make_due()
            continue
        state = chosen.run(work)
        if isinstance(work, LongJob):
            assert state in (JobState.QUEUED, JobState.SUCCEEDED)
            job_id = work.job.id
            phases.append(work.progress["phase"])
        else:
            state = None
    assert list(dict.fromkeys(phases)) == ["render", "sign", "test"]
    done = chosen.get_job(job_id)
    result, progress = MapImportResult.model_validate(done.result), done.progress
    frames = chosen.list_frames("hall", limit=1000).items
    assert result.views == sum(frame.state == FrameState.INDEXED for frame in frames) > 0
    assert (result.session, result.parent_frame) == ("room", "r1/room")
    for frame in frames:
        assert frame.tags == ["given", "virtual"]
        assert frame.pose.parent_frame == "r1/room"
        # up in the sensor, turned by the pose, is that of the file
        up = np.array(frame.pose.matrix)[:3, :3] @ [frame.up.x, frame.up.y, frame.up.z]
        np.testing.assert_allclose(up, [0, 0, 1], atol=1e-9)
    assert result.tested == result.found + result.wrong + result.ambiguous + result.not_found > 0
    assert result.wrong == 0
    assert result.coverage == result.found / result.tested
    assert progress.views == progress.rendered == progress.signed == len(frames) + result.refused
    assert used_bytes(chosen) == sum(frame.bytes for frame in frames)
    # most frames that bear a pose out are read beside the one candidate
    query = Query(candidates=1, keep=False)
    there = localization_of(chosen.query_frame("hall", frames[0].frame_id, query))
    assert (there.evidence or there.alternatives[0].evidence).rendered
    items = chosen.imports.items("hall", job_id, limit=1000).items
    assert {item.frame_id for item in items} - {None} == {item.frame_id for item in frames}


def test_a_slice_that_was_lost_adds_nothing_twice(chosen, monkeypatch):
    monkeypatch.setattr(map_import, "_AT_ONCE", 3)
    task = claim_long(chosen)
    lost = slice_of(chosen, task, lambda: True)
    assert [item["status"] for item in lost.items] == [202, 202, 202]
    again = slice_of(chosen, task, lambda: False)  # there is time for all now
    assert [item["status"] for item in again.items[:3]] == [200, 200, 200]
    assert [i["frame_id"] for i in again.items[:3]] == [i["frame_id"] for i in lost.items]
    names = [frame.name for frame in chosen.list_frames("hall", limit=1000).items]
    assert len(set(names)) == len(names) > 3
    assert set(names) <= {f"room.ply/{i:05d}" for i in range(task.progress["views"])}


def test_what_the_quota_has_no_room_for_is_refused_as_early_as_can_be(chosen, monkeypatch):
    monkeypatch.setattr("sceneprint.engine.ingest.archive_import.TIDY_S", 0.0)
    task = claim_long(chosen)
    edit_map(chosen.store, "hall", {"quota_frames": 1})
    before = replace(task, job=replace(task.job, progress={**task.progress, "phase": "choose"}))
    with pytest.raises(QuotaExceeded, match=r"has \d+ views, .* 1 frames"):
        slice_of(chosen, before, lambda: True)
    edit_map(chosen.store, "hall", {"quota_frames": None, "quota_bytes": used_bytes(chosen) + 10})
    with pytest.raises(QuotaExceeded):
        begun(chosen, b"ply\n" + bytes(20))
    assert chosen.run(task) == JobState.FAILED
    error = str(chosen.get_job(task.job.id).error)
    assert "0 of" in error
    assert "the same file again to add the remaining views" in error
    chosen.imports.tidy()
    assert (used_bytes(chosen), list(chosen.store.blobs.digests())) == (0, [])


def test_a_surface_needs_room_beyond_that_of_its_file(empty):
    rows = "".join(f"{x} {y} {z}\n" for x in range(9) for y in range(9) for z in range(9))
    data = "ply\nformat ascii 1.0\nelement vertex 729\nproperty float x\nproperty float y\n"
    data += f"property float z\nend_header\n{rows}"
    job = begun(empty, data.encode())
    edit_map(empty.store, "hall", {"quota_bytes": len(data) + 10})
    assert empty.run(claim_long(empty)) == JobState.FAILED
    assert "its quota is" in str(empty.get_job(job.job_id).error)
    assert used_bytes(empty) == len(data)


#: Where a room lies in the coordinates of a country, metres.
FAR = np.array([431_000.25, 5_411_000.5, 300.0])


def room_at(place):
    """The room as an OBJ file, whose numbers have as many digits as they need."""
    room = make_room(np.random.default_rng(3))
    corners = "".join(
        f"v {x:.4f} {y:.4f} {z:.4f}\n" for x, y, z in (room.vertices + place).tolist()
    )
    return (corners + "".join(f"f {a} {b} {c}\n" for a, b, c in room.faces + 1)).encode()


@pytest.mark.thorough
def test_files_in_one_parent_frame_need_one_offset(empty):
    def slices(place, name, count, **more):
        job = begun(empty, room_at(place), name=name, parent_frame="district", **more)
        for _ in range(count):
            task = claim_long(empty)
            assert task.job.id == job.job_id
            state = empty.run(task)
        if state == JobState.QUEUED:
            cancel(empty.store, job.job_id)
        return task

    def places():
        listed = empty.list_frames("hall", limit=1000).items
        return {row.name: np.array(row.pose.matrix)[:3, 3] for row in listed}

    slices(FAR, "west.obj", 3)
    west = places()
    # in the middle of the room, to a metre
    assert all((np.abs(at) < 6).all() for at in west.values())
    east = FAR + np.array([50.0, 0.0, 0.0])
    failed = slices(east, "east.obj", 3)
    error = str(empty.get_job(failed.job.id).error)
    assert "'district' already has frames" in error
    offset = np.round(FAR + np.ptp(make_room(np.random.default_rng(3)).vertices, axis=0) / 2)
    stated = dict(zip("xyz", offset.tolist(), strict=True))
    far_off = slices(east, "east.obj", 1, offset=stated | {"y": 0.0})
    assert "20 km from the offset" in str(empty.get_job(far_off.job.id).error)
    slices(east, "east.obj", 3, offset=stated)
    there = {name: at for name, at in places().items() if name not in west}
    assert there
    assert all((np.abs(at - [50.0, 0.0, 0.0]) < 6).all() for at in there.values())


def test_files_that_are_no_map_are_refused(empty, room_mesh):
    for data in (b"", b"no map at all", b"PK\x03\x04" + bytes(600)):
        with pytest.raises((UnreadableCloud, InvalidRequest)):
            begun(empty, data, name="room")
    assert list(empty.store.blobs.digests()) == []
    job = begun(empty, room_mesh[: len(room_mesh) // 2])
    assert empty.run(claim_long(empty)) == JobState.FAILED
    assert "room.ply" in str(empty.get_job(job.job_id).error)
    empty.create_map(NewMap(name="yard", model="lidar"))
    with (
        pytest.raises(InvalidRequest, match="`camera` would have no effect"),
        empty.imports.receive("yard", options_of()),
    ):
        pass


def test_weak_areas_are_where_most_views_are_lost():
    points = np.zeros((3, 3), np.float32)
    surface = ReferenceSurface(points, None, np.zeros(3), np.array([0.0, 0.0, 1.0]))
    held_out = np.tile(np.eye(4), (14, 1, 1))
    held_out[:10, 0, 3], held_out[10:, 0, 3] = 0.1, 9.1
    held_out[:, 1, 3], held_out[:, 2, 3] = 0.1, 1.5
    stored = StoredSurface(surface, held_out, held_out, 0.5)
    outcomes = ["found"] * 11 + ["ambiguous", "not_found", "wrong"]
    [area] = weak_areas(stored, outcomes)
    assert (area.views, area.found) == (4, 1)
    assert area.width_m == 0.5
    assert (area.centre.x, area.centre.y, area.centre.z) == (9.25, 0.25, 0.5)
    assert weak_areas(stored, ["found"] * 14) == []
