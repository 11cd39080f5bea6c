"""Blobs of no living frame: files of jobs, tiles, uploads that can be restored."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from sceneprint.bundle.backup import take_backup
from sceneprint.bundle.restoration import restore_to_folder
from sceneprint.engine import Engine
from sceneprint.formats.depth_file import encode_png
from sceneprint.maintenance.fsck.check import fsck
from sceneprint.settings import Settings
from sceneprint.store import Store
from sceneprint.store.maps import find_map
from sceneprint.store.query_rows import (
    NewQuery,
    WantedQueries,
    add_queries,
    keep_answer,
    list_queries,
    read_kept,
)
from sceneprint.store.queue import JobFile, add_files, files_of, find_job
from sceneprint.store.surface_rows import add_surface, find_surface, tiles_to_rebuild, write_tile
from sceneprint_client.api import CameraIntrinsics, FrameMeta, NewMap


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings(data_dir=tmp_path / "data", cache_dir=tmp_path / "cache", database_url=None)


@pytest.fixture
def made(settings: Settings) -> tuple[str, str]:
    """A job with two files; ids of the job and of the first blob."""
    with Engine(settings) as engine:
        engine.create_map(NewMap(name="hall", model="depth"))
        job, _ = engine.tasks.begin("reconstruct", "hall", {})
        blob = engine.store.blobs.put(b"a mesh")
        other = engine.store.blobs.put(b"a picture")
        with engine.store.database.write() as connection:
            files = [
                JobFile("mesh.ply", blob, 6, "model/ply"),
                JobFile("picture.png", other, 9, "image/png"),
            ]
            add_files(connection, find_job(connection, job.job_id).number, files)
    return job.job_id, blob


def names(store: Store, job_id: str) -> list[str]:
    with store.database.read() as connection:
        return list(files_of(connection, find_job(connection, job_id).number))


@pytest.mark.sqlite_only("restores to a database of its own in the folder")
def test_sound_files_of_jobs_are_no_finding_and_belong_to_a_snapshot(settings, made, tmp_path):
    assert list(fsck(settings, grace_s=0)) == []
    take_backup(settings, str(tmp_path / "all"))
    restore_to_folder(str(tmp_path / "all"), tmp_path / "again")
    with Engine(Settings(data_dir=tmp_path / "again", database_url=None)) as engine:
        assert names(engine.store, made[0]) == ["mesh.ply", "picture.png"]
        assert engine.store.blobs.get(made[1]) == b"a mesh"


@pytest.mark.parametrize("condition", ["damaged", "missing"])
def test_a_lost_file_of_a_job_is_named_and_forgotten(settings, made, condition):
    job_id, blob = made
    path = settings.blob_dir / blob[:2] / blob
    if condition == "missing":
        path.unlink()
    else:
        path.chmod(0o600)
        path.write_bytes(b"a mush")
    (found,) = fsck(settings, grace_s=0)
    assert (found.finding.kind, found.finding.map) == (f"{condition}-job-file", "hall")
    assert found.finding.what == f"mesh.ply of job {job_id} (reconstruct)"
    (done,) = fsck(settings, grace_s=0, repair=True)
    assert done.done is not None
    assert done.done.endswith("the job has it no more")
    assert list(fsck(settings, grace_s=0)) == []
    with Engine(settings) as engine:
        assert names(engine.store, job_id) == ["picture.png"]
    kept = [one.read_bytes() for one in settings.data_dir.rglob(f"quarantine/*{blob}*")]
    assert kept == ([b"a mush"] if condition == "damaged" else [])


@pytest.fixture
def tiled(settings: Settings) -> str:
    """Blob of the one tile of a surface, which is up to date."""
    with Engine(settings) as engine:
        engine.create_map(NewMap(name="hall", model="depth"))
        blob = engine.store.blobs.put(b"cells")
        with engine.store.database.write() as connection:
            row = find_map(connection, "hall")
            add_surface(connection, row)
            values = {"blob": blob, "digest": "d", "cells": 1, "scale": 0}
            write_tile(connection, row.number, "room", 0, (0, -1, 2), values)
    return blob


def test_sound_tiles_are_no_finding_and_belong_to_a_snapshot(settings, tiled, tmp_path):
    assert list(fsck(settings, grace_s=0)) == []
    take_backup(settings, str(tmp_path / "all"))
    restore_to_folder(str(tmp_path / "all"), tmp_path / "again")
    with Engine(Settings(data_dir=tmp_path / "again", database_url=None)) as engine:
        assert engine.store.blobs.get(tiled) == b"cells"


@pytest.mark.parametrize("condition", ["damaged", "missing"])
def test_a_lost_tile_is_named_and_made_again(settings, tiled, condition):
    path = settings.blob_dir / tiled[:2] / tiled
    if condition == "missing":
        path.unlink()
    else:
        path.chmod(0o600)
        path.write_bytes(b"calls")
    (found,) = fsck(settings, grace_s=0)
    assert (found.finding.kind, found.finding.map) == (f"{condition}-tile", "hall")
    assert found.finding.what == "tile (0, -1, 2) of level 0 of map hall"
    (done,) = fsck(settings, grace_s=0, repair=True)
    assert done.done is not None
    assert done.done.endswith("a worker makes it again")
    assert list(fsck(settings, grace_s=0)) == []
    with Engine(settings) as engine, engine.store.database.read() as connection:
        row = find_map(connection, "hall")
        (tile,) = tiles_to_rebuild(connection, row.number, 10)
        assert (tile.place, tile.blob, tile.rebuilt_to) == ((0, -1, 2), None, 0)
        surface = find_surface(connection, row.number)
        assert surface is not None
        assert surface.edits < surface.pose_edits  # so that workers look at it


@pytest.fixture
def deletion(settings: Settings) -> str:
    """Id of a deletion that can be undone, in a store that has a kept answer and another one."""
    with Engine(settings) as engine:
        engine.create_map(NewMap(name="hall", model="depth"))
        png = encode_png(np.full((48, 64), 2000, np.uint16))
        lens = CameraIntrinsics(width=64, height=48, fx=60, fy=60, cx=32, cy=24)
        frame, _ = engine.add_frame("hall", png, FrameMeta(intrinsics=lens, robot="r1"))
        with engine.store.database.write() as connection:
            add_queries(connection, [query_of("a"), query_of("b"), query_of("c", listed=False)])
            keep_answer(connection, 1, b"an answer", 1.0)
        engine.delete_frame("hall", frame.frame_id)
        (found,) = engine.tombstones.list_all("hall", None, 9).items
    return found.deletion_id


def query_of(letter: str, *, listed: bool = True) -> NewQuery:
    return NewQuery(
        id=letter * 32, at=time.time(), map="hall", maps=None, robot=None, session=None,
        status="found", cause=None, reason="", pose_parent=None, pose=None, confidence=None,
        support=None, alternatives=0, milliseconds=1.0, kind=None, frame_map=None,
        frame_id=None, key_id=None, listed=listed, bytes=9,
    )  # fmt: skip


@pytest.mark.sqlite_only("restores to a database of its own in the folder")
def test_a_snapshot_has_kept_answers_and_what_can_be_restored(settings, deletion, tmp_path):
    assert list(fsck(settings, grace_s=0)) == []
    take_backup(settings, str(tmp_path / "all"))
    restore_to_folder(str(tmp_path / "all"), tmp_path / "again")
    again = Settings(data_dir=tmp_path / "again", database_url=None)
    assert list(fsck(again, grace_s=0)) == []
    with Engine(again) as engine:
        with engine.store.database.read() as connection:
            rows = list_queries(connection, WantedQueries(), None, 9)
            assert [(one.id[0], one.kept_at, one.bytes) for one in rows] == [
                ("b", None, 0), ("a", 1.0, 9)
            ]  # fmt: skip
            assert read_kept(connection, rows[1].number) == b"an answer"
        done = engine.tombstones.restore("hall", deletion)
        assert done.frames == 1
        assert [one.robot for one in engine.list_frames("hall").items] == ["r1"]
    assert list(fsck(again, grace_s=0)) == []
