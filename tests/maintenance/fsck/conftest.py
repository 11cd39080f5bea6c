"""Fixtures of the fsck tests: a data folder with objects of every kind, and damage to it."""

from __future__ import annotations

import shutil
import sqlite3
import zlib
from contextlib import closing

import pytest
from sqlalchemy import NullPool, create_engine, make_url

from sceneprint.engine.maps.tombstones import Tombstones
from sceneprint.maintenance.fsck.check import fsck
from sceneprint.models import open_table, write_model
from sceneprint.settings import Settings
from sceneprint.store.maps import add_map, find_map, store_model
from sceneprint.store.queue import JobFile, add_files, find_job
from sceneprint.store.surface_rows import add_surface, write_tile
from sceneprint_client.api import JobState, Query
from tests.bundle.conftest import small_uploads
from tests.whole_engine import Engine

#: Number of frames of `hall`, all signed; the first index holds half of them, the second all.
HALL = 12


class House:
    """A data folder with its cache folder, and actions on them."""

    def __init__(self, place, url=None, cache=None):
        self.place, self.data = place, place / "data"
        self.settings = Settings(
            data_dir=self.data, cache_dir=cache or place / "cache", database_url=url,
            index_dir=None, unindexed_frames=HALL // 2 - 1,
        )  # fmt: skip

    @property
    def is_sqlite(self):
        return make_url(self.settings.database).get_backend_name() == "sqlite"

    def look(self, **how):
        return list(fsck(self.settings, **how))

    def kinds(self, **how):
        return [finding.kind for finding in self.look(**how)]

    def files(self):
        """Return the checksum of every file, and the names of folders."""
        return {
            str(path.relative_to(self.place)): (
                zlib.crc32(path.read_bytes()) if path.is_file() else None
            )
            for path in self.place.rglob("*")
        }

    def sql(self, statement, *values):
        """Query or change the database without its checks, and without a log."""
        if self.is_sqlite:
            with closing(sqlite3.connect(self.data / "sceneprint.db")) as database:
                rows = database.execute(statement, values).fetchall()
                database.commit()
            return rows
        engine = create_engine(self.settings.database, poolclass=NullPool)
        with engine.begin() as connection:
            connection.exec_driver_sql("SET session_replication_role = replica")
            result = connection.exec_driver_sql(statement.replace("?", "%s"), values)
            return [tuple(row) for row in result] if result.returns_rows else []

    def blob(self, digest):
        return self.data / "blobs" / digest[:2] / digest

    def index_files(self, kind):
        """Return files of a kind of the newest version of `hall`, or its manifest."""
        manifest = max((self.data / "index").glob("hall*/*.json"))
        if kind == "json":
            return [manifest]
        named = manifest.read_text()
        return [path for path in manifest.parent.glob(f"*.{kind}") if path.name in named]

    def damage(self, path, condition="damaged", at=7, bit=0):
        data = bytearray(path.read_bytes())
        data[at] ^= 1 << bit
        path.unlink()
        if condition == "damaged":
            path.write_bytes(data)
        return bytes(data)

    def quarantined(self):
        return [path.read_bytes() for path in self.data.glob("quarantine/*")]

    def work(self):
        with Engine(self.settings) as engine:
            states = engine.work_off()
            engine.publish_due()
        return states

    def answers(self, uploads, without=""):
        results = []
        with Engine(self.settings) as engine:
            for each in uploads:
                query = Query(exact=True, k=50, stages=("retrieve",))
                answer = engine.queries.upload(["hall"], each.data, each.meta, query)
                results.append(
                    [(m.frame_id, m.distance) for m in answer.matches if m.frame_id != without]
                )
        return results


def add_products(engine):
    """Add a job of `hall` with two files, and a tile; returns the job's id and the blobs."""
    job, _ = engine.begin_task("reconstruct", "hall", {})
    blobs = [engine.store.blobs.put(data) for data in (b"a picture", b"a mesh", b"cells")]
    picture = JobFile("picture.png", blobs[0], 9, "image/png")
    mesh = JobFile("mesh.ply", blobs[1], 6, "model/ply")
    with engine.store.database.write() as connection:
        add_files(connection, find_job(connection, job.job_id).number, [picture, mesh])
        row = find_map(connection, "hall")
        add_surface(connection, row)
        tile = {"blob": blobs[2], "digest": "d", "cells": 1, "scale": 0}
        write_tile(connection, row.number, "room", 0, (0, -1, 2), tile)
    return job.job_id, blobs


@pytest.fixture(scope="session")
def uploads(room_frames, small_image):
    return small_uploads(room_frames, small_image)


@pytest.fixture(scope="session")
def master(uploads, small_whitened, tmp_path_factory):
    """A read-only store: `hall` with two versions of its index, and `attic`.

    `attic` has a signed frame, a deleted one and a waiting one.
    """
    house = House(tmp_path_factory.mktemp("master"))
    open_table(small_whitened, house.settings.cache_dir)
    with Engine(house.settings) as engine:
        with engine.store.database.write() as connection:
            store_model(connection, small_whitened.id, "small", write_model(small_whitened))
            for name in ("hall", "attic"):
                add_map(connection, name, None, small_whitened.id)

        def add(name, some):
            for each in some:
                engine.add_frame(name, each.data, each.meta)

        for start in (0, HALL // 2):
            add("hall", uploads[start : start + HALL // 2])
            assert set(engine.work_off()) == {JobState.SUCCEEDED}
            assert engine.publish_due() == 1
        add("attic", uploads[HALL : HALL + 2])
        assert set(engine.work_off()) == {JobState.SUCCEEDED}
        engine.tombstones = Tombstones(engine.store, 0.0, engine.bell.ring)
        engine.delete_frame("attic", engine.list_frames("attic").items[0].frame_id)
        add("attic", [uploads[HALL + 2]])
    return house


@pytest.fixture(scope="session")
def copied(master):
    def copy(place):
        shutil.copytree(master.place, place)
        return House(place)

    return copy


@pytest.fixture(scope="session")
def house_at():
    """A function that returns the data folder of a place, perhaps with a database elsewhere."""
    return House


@pytest.fixture
def house(copied, tmp_path):
    return copied(tmp_path / "house")


@pytest.fixture(scope="session")
def truth(master, copied, uploads, tmp_path_factory):
    return copied(tmp_path_factory.mktemp("truth") / "house").answers(uploads[:HALL])
