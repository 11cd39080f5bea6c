"""Fixtures of the bundle tests: a data folder with objects of every kind, and its bundle."""

from __future__ import annotations

import hashlib
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.bundle.backup import take_backup
from sceneprint.engine.ingest.uploads import Upload
from sceneprint.settings import Settings
from sceneprint_client.api import FrameMeta, GivenPose, JobState, NewMap, Query
from tests.whole_engine import Engine

SIGNED = 4


def settings_of(folder):
    """Return settings of a data folder, independent of the environment; deletions are immediate."""
    return Settings(data_dir=folder, database_url=None, index_dir=None, undo_window_s=0)


@pytest.fixture(scope="session")
def settings():
    return settings_of


def small_uploads(room_frames, small_image):
    """Return 24 small frames with poses and tags, from four offsets of each of six views."""
    results = []
    for number, frame in enumerate(room_frames):
        for place in range(4):
            data, camera = small_image(frame, *divmod(place, 2))
            pose = GivenPose(parent_frame=frame.name[:-2], matrix=frame.pose.tolist())
            tags = ["all", f"view-{number}"]
            results.append(Upload(data, FrameMeta(intrinsics=camera, pose=pose, tags=tags)))
    return results


@pytest.fixture(scope="session")
def uploads(room_frames, small_image):
    return small_uploads(room_frames, small_image)


@pytest.fixture(scope="session")
def master(uploads, tmp_path_factory):
    """A read-only data folder with signed, deleted and waiting frames, a key and an orphan."""
    folder = tmp_path_factory.mktemp("master") / "data"
    with Engine(settings_of(folder)) as engine:
        engine.create_map(NewMap(name="hall", model="depth"))
        for each in uploads[: SIGNED + 1]:
            engine.add_frame("hall", each.data, each.meta)
        assert set(engine.work_off()) == {JobState.SUCCEEDED}
        engine.delete_frame("hall", engine.list_frames("hall").items[SIGNED].frame_id)
        engine.add_frame("hall", uploads[SIGNED + 1].data, uploads[SIGNED + 1].meta)
        engine.store.blobs.put(b"nothing refers to this")
        engine.create_key("robot")
    return folder


@pytest.fixture
def data(master, tmp_path):
    return Path(shutil.copytree(master, tmp_path / "data"))


@pytest.fixture(scope="session")
def place(master, tmp_path_factory):
    folder = str(tmp_path_factory.mktemp("place") / "bundles")
    take_backup(settings_of(master), folder)
    return folder


@pytest.fixture(scope="session")
def content():
    """A function that returns the SQL dump and the hashes of the blobs of a data folder."""

    def of(folder):
        with closing(sqlite3.connect(folder / "sceneprint.db")) as database:
            sql = "\n".join(sorted(database.iterdump()))
        blobs = [path for path in (folder / "blobs").rglob("*") if path.is_file()]
        return {"": sql} | {
            str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
            for path in blobs
        }

    return of


@pytest.fixture(scope="session")
def rows():
    def ask(folder, statement):
        with closing(sqlite3.connect(folder / "sceneprint.db", timeout=PATIENCE_S)) as database:
            results = database.execute(statement).fetchall()
            database.commit()
            return results

    return ask


@pytest.fixture(scope="session")
def answers():
    def of(settings, uploads):
        free = {"query_id": "", "milliseconds": {}}
        with Engine(settings) as engine:
            return [
                engine.queries.upload(["hall"], u.data, u.meta, Query(exact=True)).model_copy(
                    update=free
                )
                for u in uploads
            ]

    return of


@pytest.fixture
def sceneprint(run_command, monkeypatch):
    monkeypatch.delenv("SCENEPRINT_DATABASE_URL", raising=False)

    def run(*arguments, expect=0):
        output = run_command(*arguments, expect=expect)
        if expect == 2:
            assert output.stdout == ""
            assert output.stderr.count("\n") == 1
        return output

    return run
