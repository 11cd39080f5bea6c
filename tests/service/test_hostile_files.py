"""Tests of missing, damaged and mismatched files under running processes."""

import shutil
from pathlib import Path

import pytest

from sceneprint.engine.jobs import lifecycle
from sceneprint.errors import UnusableStore
from sceneprint.settings import Settings
from sceneprint_client.api import FrameMeta, FrameState, JobState, NewMap
from tests.whole_engine import Engine

HALL = "/v1/maps/hall"
NEAREST = {"stages": ["retrieve"], "k": 9, "exact": True}


def opened(folder, **more):
    return Engine(Settings.model_validate({"data_dir": folder, "database_url": None, **more}))


def meta_of(shot):
    return FrameMeta.model_validate({"intrinsics": shot.camera})


@pytest.fixture(scope="module")
def stored(small_shots, tmp_path_factory):
    """A folder whose map has two versions, of three and of six frames, and three frames more."""
    folder = tmp_path_factory.mktemp("stored") / "data"
    with opened(folder, unindexed_frames=2) as engine:
        engine.create_map(NewMap(name="hall", model="depth"))
        for number, shot in enumerate(small_shots[:9]):
            engine.add_frame("hall", shot.png, meta_of(shot))
            work = engine.claim("w")
            assert work is not None
            assert engine.run(work) == JobState.SUCCEEDED
            if number in (2, 5):
                assert engine.publish_due() == 1
    assert len(list(folder.glob("index/hall-*/*.json"))) == 2
    return folder


@pytest.fixture
def folder(stored, tmp_path):
    """A copy, to be damaged."""
    return Path(shutil.copytree(stored, tmp_path / "data"))


def nearest(server, frame_id):
    answer = server.client.post(f"{HALL}/queries", json={"frame_id": frame_id, **NEAREST})
    assert answer.status_code == 200, answer.text
    return dict(answer.json())


def test_blobs_that_are_missing_cost_what_needs_them(
    folder, begin, small_shots, refused, rows, monkeypatch
):
    monkeypatch.setenv("SCENEPRINT_GEOMETRY_CACHE_BYTES", "0")  # of which none is in memory
    server = begin("--workers", "0", folder=folder)
    frames = [frame["frame_id"] for frame in server.client.get(f"{HALL}/frames").json()["items"]]
    query = "SELECT s.geometry FROM signatures s JOIN frames f ON f.number = s.frame_number"
    ((blob,),) = rows(folder, f"{query} WHERE f.id = '{frames[0]}'")
    (folder / "blobs" / blob[:2] / blob).unlink()
    answer = server.client.post(f"{HALL}/queries", **small_shots[1].form()).json()
    validations = {match["frame_id"]: match["validation"] for match in answer["matches"]}
    assert validations[frames[0]]["status"] == "skipped"
    assert "No such file" in validations[frames[0]]["reason"]
    assert (answer["status"], validations[frames[1]]["status"]) == ("found", "accepted")
    own = server.client.post(f"{HALL}/queries", json={"frame_id": frames[0]})
    assert (own.status_code, own.json()["status"]) == (200, "found")  # made of its upload
    assert nearest(server, frames[0])["counts"]["compared"] == 8  # without the stage that needs it
    (folder / "blobs").rename(folder / "away")
    answer = server.client.post(f"{HALL}/queries", **small_shots[1].form())
    assert (answer.status_code, answer.json()["status"]) == (200, "not_found")
    assert {match["validation"]["status"] for match in answer.json()["matches"]} == {"skipped"}
    assert server.client.get(f"{HALL}/frames/{frames[2]}").json()["state"] == "indexed"
    sent = server.client.post(f"{HALL}/frames", **small_shots[20].form())
    refused(sent, 503, "unusable-store", "nothing was stored")
    assert not (folder / "blobs").exists()  # a disk that was unmounted comes back, with its blobs
    (folder / "away").rename(folder / "blobs")
    assert server.client.post(f"{HALL}/frames", **small_shots[20].form()).status_code == 202


def due(truth, folder):
    """Let the time come at which what waits may be claimed."""
    with truth(folder) as connection:
        connection.exec_driver_sql("UPDATE jobs SET run_after = 0")


def test_a_store_that_takes_no_artifact_costs_a_frame_no_try(
    stored, folder, tmp_path, small_shots, monkeypatch, rows, truth
):
    """The blob cannot be written, and the database can: no fault of the frame's."""
    shot = small_shots[30]
    artifact, query = "", "SELECT geometry FROM signatures ORDER BY frame_number DESC LIMIT 1"
    with opened(Path(shutil.copytree(stored, tmp_path / "trial"))) as engine:
        engine.add_frame("hall", shot.png, meta_of(shot))
        work = engine.claim("w")
        assert engine.run(work) == JobState.SUCCEEDED
        ((artifact,),) = rows(tmp_path / "trial", query)
    with opened(folder) as engine:
        added, _ = engine.add_frame("hall", shot.png, meta_of(shot))
        place = folder / "blobs" / artifact[:2]
        if place.exists():
            place.rename(folder / "away")
        place.write_bytes(b"a file where the folder should be")
        with monkeypatch.context() as patch:
            patch.setattr(lifecycle, "DELAY_S", 50.0)
            with pytest.raises(UnusableStore):
                engine.run(engine.claim("w"))
            assert engine.claim("w") is None  # it lets others go first
            other, _ = engine.add_frame("hall", small_shots[31].png, meta_of(small_shots[31]))
            work = engine.claim("w")
            assert work.frame.id == other.frame_id
            assert engine.run(work) == JobState.SUCCEEDED
        due(truth, folder)
        monkeypatch.setattr(lifecycle, "DELAY_S", 0.0)
        for _ in range(4):  # more often than a frame may break down
            work = engine.claim("w")
            assert work is not None
            with pytest.raises(UnusableStore):
                engine.run(work)
            assert engine.get_frame("hall", added.frame_id).state == FrameState.RECEIVED
            assert engine.get_job(added.job_id).attempts == 0
        place.unlink()
        work = engine.claim("w")
        assert work is not None
        assert engine.run(work) == JobState.SUCCEEDED
