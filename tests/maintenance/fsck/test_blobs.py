"""Tests of lost and damaged blobs, and of unreferenced files."""

import os
import shutil
import time

import pytest

from sceneprint.maintenance.fsck.check import check_frames
from sceneprint.maintenance.fsck.findings import GONE, Folder
from sceneprint.store.maps import find_map
from sceneprint.store.queue import files_of, find_job
from sceneprint.store.surface_rows import find_surface, tiles_to_rebuild
from tests.maintenance.fsck.conftest import add_products
from tests.whole_engine import Engine

DIGEST = "ab" * 32
FIRST = "SELECT f.id, f.blob, geometry FROM frames f JOIN signatures ON frame_number = number"
WAITING = "SELECT id, blob, state, reason FROM frames WHERE state IN ('received', 'failed')"


def age(path, seconds):
    then = time.time() - seconds
    os.utime(path, (then, then))


def only(result):
    (one,) = result
    return one


@pytest.fixture
def lost(house):
    """Returns the file of a blob of a kind, and what fsck calls it."""

    def place(kind):
        if kind in ("upload", "artifact"):
            frame_id, upload, artifact = house.sql(f"{FIRST} ORDER BY number")[0]
            blob = upload if kind == "upload" else artifact
            return house.blob(blob), f"the {kind} of frame {frame_id} of map hall"
        with Engine(house.settings) as engine:
            job_id, blobs = add_products(engine)
        if kind == "job-file":
            return house.blob(blobs[1]), f"job-file mesh.ply of job {job_id}"
        return house.blob(blobs[2]), "tile 0,-1,2 of level 0 of map hall"

    return place


REPAIRS = {
    "upload": "the frame is indexed, and its reason describes the loss",
    "artifact": "a worker computes it again from the upload",
    "job-file": "the file is removed from the job",
    "tile": "a worker computes it again from the frames",
}


@pytest.mark.parametrize("condition", ["damaged", "missing"])
@pytest.mark.parametrize("kind", REPAIRS)
def test_a_lost_blob_is_named_and_repaired(house, lost, kind, condition):
    path, what = lost(kind)
    assert house.look() == []
    damaged = house.damage(path, condition, at=3)
    before = house.files()
    actual = only(house.look())
    assert (actual.kind, actual.what, actual.map) == (f"{condition}-{kind}", what, "hall")
    assert (actual.severity, actual.path, actual.left) == ("damage", str(path), True)
    assert house.files() == before
    done = only(house.look(repair=True)).done
    aside = house.data / "quarantine" / f"blob-{path.name}"
    moved = f"moved to {aside}; " if condition == "damaged" else ""
    assert done == moved + REPAIRS[kind]
    assert not path.exists()
    assert house.quarantined() == ([damaged] if moved else [])
    # what is left to do is a worker's, or a robot's
    known = [(finding.kind, finding.severity) for finding in house.look()]
    assert known == ([(f"missing-{kind}", "note")] if kind in ("upload", "artifact") else [])
    with Engine(house.settings) as engine, engine.store.database.read() as connection:
        if kind == "job-file":
            job = find_job(connection, what.split()[-1])
            assert list(files_of(connection, job.number)) == ["picture.png"]
        if kind == "tile":
            row = find_map(connection, "hall")
            tile = only(tiles_to_rebuild(connection, row.number, 10))
            assert (tile.blob, tile.rebuilt_to) == (None, 0)
            surface = find_surface(connection, row.number)
            assert surface.edits < surface.pose_edits  # so that workers look at it


def test_a_repair_looks_again_before_it_writes(house, lost):
    path, _ = lost("upload")
    path.rename(house.place / "away")
    house.sql("UPDATE frames SET pose_x = pose_x + 1 WHERE number = 1")
    house.damage(house.blob(house.sql("SELECT blob FROM frames WHERE number = 2")[0][0]))
    with Engine(house.settings) as engine:
        actual = list(check_frames(Folder(house.settings, engine.store), [1, 2]))
        assert [item.kind for item in actual] == ["stale-value", "missing-upload", "damaged-upload"]
        (house.place / "away").rename(path)
        house.sql("UPDATE frames SET pose_x = pose_x - 1 WHERE number = 1")
        engine.delete_frame("hall", str(actual[2].frame_id))
        engine.purging.now()
        before = house.sql("SELECT * FROM frames ORDER BY number")
        assert [item.repair and item.repair() for item in actual] == [GONE] * 3
    assert house.sql("SELECT * FROM frames ORDER BY number") == before
    assert house.quarantined() == []


def test_a_lost_artifact_is_made_again_and_nobody_has_to_learn_of_it(house, lost, truth, uploads):
    path, _ = lost("artifact")
    sound = path.read_bytes()
    house.damage(path)
    house.look(repair=True)
    assert house.answers(uploads[:12]) == truth  # found meanwhile
    before = house.sql("SELECT revision FROM maps WHERE name = 'hall'")
    assert set(house.work()) == {"succeeded"}
    assert path.read_bytes() == sound
    assert house.look() == []
    assert house.sql("SELECT revision FROM maps WHERE name = 'hall'") == before


@pytest.mark.parametrize("state", ["indexed", "received"])
def test_a_lost_upload_may_come_again(house, state, truth, uploads):
    rows = house.sql(f"{FIRST} ORDER BY number" if state == "indexed" else WAITING)
    name, (frame_id, blob) = "hall" if state == "indexed" else "attic", rows[0][:2]
    sound = house.blob(blob).read_bytes()
    house.damage(house.blob(blob))
    house.look(repair=True)
    but = "it can be found, but not signed again"
    after = [("indexed", but)] if state == "indexed" else [("failed", "it cannot be signed")]
    assert house.sql("SELECT state, reason FROM frames WHERE id = ?", frame_id) == [
        (end, f"its upload is damaged: {why}; upload it again to heal") for end, why in after
    ]
    if state == "received":
        assert house.work() == []  # its job is over
    assert house.answers(uploads[:12]) == truth
    (own,) = (each for each in uploads if each.data == sound)
    with Engine(house.settings) as engine:
        added, new = engine.add_frame(name, own.data, own.meta)
    assert (added.frame_id, added.reason, new) == (frame_id, None, state == "received")
    assert house.work() == ["succeeded"]  # that of the frame which waited
    assert house.look() == []


@pytest.mark.parametrize("state", ["indexed", "received"])
def test_an_upload_that_is_found_again_clears_the_reason(house, state):
    frame_id, blob = house.sql(FIRST if state == "indexed" else WAITING)[0][:2]
    house.blob(blob).rename(house.place / "away")
    house.look(repair=True)
    (house.place / "away").rename(house.blob(blob))
    actual = only(house.look())
    assert (actual.kind, actual.severity, actual.frame_id) == ("found-upload", "leftover", frame_id)
    assert only(house.look(repair=True)).done is not None
    statement = "SELECT state, reason FROM frames WHERE id = ?"
    assert house.sql(statement, frame_id) == [(state, None)]
    assert house.work() == ["succeeded"]
    assert house.sql(statement, frame_id) == [("indexed", None)]


@pytest.mark.parametrize("product", ["artifact", "signature"])
def test_what_was_made_of_a_lost_upload_cannot_be_made_again(house, product, truth, uploads):
    frame_id, upload, artifact = house.sql(f"{FIRST} ORDER BY number")[0]
    house.blob(upload).unlink()
    if product == "artifact":
        house.damage(house.blob(artifact))
    else:
        house.sql("UPDATE signatures SET checksum = checksum + 1 WHERE frame_number = 1")
        truth = [[one for one in each if one[0] != frame_id] for each in truth]
    kinds = [each.kind for each in house.look(repair=True)]
    ((state, reason),) = house.sql("SELECT state, reason FROM frames WHERE id = ?", frame_id)
    assert "its upload is lost" in reason
    assert (kinds, state) == (
        (["missing-upload", "damaged-artifact"], "indexed") if product == "artifact"
        else (["damaged-signature", "missing-upload"], "failed")
    )  # fmt: skip
    assert house.answers(uploads[:12]) == truth
    assert house.work() == ["succeeded"]  # that of the frame which waited anyway
    again = house.look()
    assert {(each.severity, each.frame_id) for each in again} == {("note", frame_id)}


def test_a_repair_removes_nothing_under_a_backup(house):
    frame_id, blob, _ = house.sql(FIRST)[0]
    with Engine(house.settings) as engine:
        stray = house.blob(engine.store.blobs.put(b"nothing refers to this"))
        age(stray, 3700)
        house.damage(house.blob(blob))
        with engine.store.blobs.locks.block_removals():
            actual = house.look(repair=True)
            assert [item.left for item in actual] == [True, True]
            assert all("a backup or another process" in str(item.error) for item in actual)
        assert stray.exists()
        assert house.blob(blob).exists()
        assert house.sql("SELECT reason FROM frames WHERE id = ?", frame_id) == [(None,)]
        assert [finding.left for finding in house.look(repair=True)] == [False, False]
    assert not stray.exists()


@pytest.mark.sqlite_only("compares every file of the data folder")
def test_old_leftovers_are_removed_and_other_files_are_not(house):
    """A young one may be an upload between its blob and its commit."""
    blobs = house.data / "blobs"
    for name in ("ab", "12"):
        (blobs / name).mkdir(exist_ok=True)
    unneeded = [blobs / "ab" / DIGEST, blobs / "ab" / f".{'0' * 12}.part"]
    foreign = [blobs / "README", blobs / "12" / "notes.txt", blobs / "12" / DIGEST]
    for path in (*unneeded, *foreign):
        path.write_bytes(b"left by somebody")
    notes = sorted(("foreign-file", str(path), "note", False) for path in foreign)
    left = sorted(("unreferenced-file", str(path), "leftover", True) for path in unneeded)

    def look(**how):
        return sorted((one.kind, one.what, one.severity, one.left) for one in house.look(**how))

    before = house.files()
    assert look(repair=True) == notes
    assert look(grace_s=0) == [*notes, left[1]]  # the other is written for a minute yet
    for path in (*unneeded, *foreign):
        age(path, 3700)
    assert look() == [*notes, *left]
    assert look(grace_s=3800) == notes
    assert house.files() == before
    assert look(repair=True) == [*notes, *((*one[:3], False) for one in left)]
    assert [path.exists() for path in (*unneeded, *foreign)] == [False] * 2 + [True] * 3
    assert look(grace_s=0) == notes


@pytest.mark.sqlite_only("looks at the database as a file of the data folder")
def test_blobs_beside_a_database_that_knows_no_frame_are_left_alone(house):
    for path in house.data.glob("sceneprint.db*"):
        path.unlink()
    aside = house.data / "kept"
    (house.data / "blobs").rename(aside)
    Engine(house.settings).close()  # a new, empty store; then the disk is back
    shutil.rmtree(house.data / "blobs")
    aside.rename(house.data / "blobs")
    there = {path for path in (house.data / "blobs").rglob("*") if path.is_file()}
    for path in there:
        age(path, 7200)
    actual = house.look(repair=True)
    assert {(item.path, item.kind, item.severity, item.done) for item in actual} == {
        (str(path), "unreferenced-file", "note", None) for path in there
    }
    assert all(path.exists() for path in there)
