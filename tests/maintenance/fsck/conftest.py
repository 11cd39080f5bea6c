"""Fixtures of the fsck tests: a data folder with objects of every kind, and damage to it."""

from __future__ import annotations

import shutil
import sqlite3
import zlib
from contextlib import closing

import pytest
from sqlalchemy import NullPool, create_engine, make_url

from sceneprint.engine.ingest.uploads import Upload
from sceneprint.engine.maps.tombstones import Tombstones
from sceneprint.maintenance.fsck.check import fsck
from sceneprint.models import open_table, write_model
from sceneprint.settings import Settings
from sceneprint.store.maps import add_map, store_model
from sceneprint_client.api import FrameMeta, GivenPose, JobState, Query
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
        return [one.kind for one in self.look(**how)]

    def files(self):
        """Return the checksum of every file, and the names of folders."""
        return {
            str(path.relative_to(self.place)): (
                zlib.crc32(path.read_bytes()) if path.is_file() else None
            )
            for path in self.place.rglob("*")
        }

    def sql(self, asked, *values):
        """Query or change the database without its checks, and without a log."""
        if self.is_sqlite:
            with closing(sqlite3.connect(self.data / "sceneprint.db")) as database:
                found = database.execute(asked, values).fetchall()
                database.commit()
            return found
        engine = create_engine(self.settings.database, poolclass=NullPool)
        with engine.begin() as connection:
            connection.exec_driver_sql("SET session_replication_role = replica")
            result = connection.exec_driver_sql(asked.replace("?", "%s"), values)
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
        """Flip a bit of a file or remove it; return the remaining bytes."""
        data = bytearray(path.read_bytes())
        data[at] ^= 1 << bit
        path.unlink()
        if condition == "damaged":
            path.write_bytes(data)
        return bytes(data)

    def quarantined(self):
        return [path.read_bytes() for path in self.data.glob("quarantine/*")]

    def work(self):
        """Run all jobs, and publish due indexes."""
        with Engine(self.settings) as engine:
            states = []
            while (claimed := engine.claim("w")) is not None:
                states.append(engine.run(claimed))
            engine.publish_due()
        return states

    def answers(self, uploads, without=""):
        """Return the answers of `hall` without a frame and without parts that always differ."""
        found = []
        with Engine(self.settings) as engine:
            for each in uploads:
                query = Query(exact=True, k=50, stages=("retrieve",))
                answer = engine.queries.upload(["hall"], each.data, each.meta, query)
                found.append(
                    [(m.frame_id, m.distance) for m in answer.matches if m.frame_id != without]
                )
        return found


@pytest.fixture(scope="session")
def uploads(room_frames, small_image):
    """24 small frames with poses, from four offsets of each of six views."""
    found = []
    for number, frame in enumerate(room_frames):
        for place in range(4):
            data, camera = small_image(frame, *divmod(place, 2))
            pose = GivenPose(parent_frame=frame.name[:-2], matrix=frame.pose.tolist())
            tags = ["all", f"view-{number}"]
            meta = FrameMeta(intrinsics=camera, pose=pose, tags=tags)
            found.append(Upload(data, meta))
    return found


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
            while (work := engine.claim("w")) is not None:
                assert engine.run(work) == JobState.SUCCEEDED
            assert engine.publish_due() == 1
        add("attic", uploads[HALL : HALL + 2])
        while (work := engine.claim("w")) is not None:
            assert engine.run(work) == JobState.SUCCEEDED
        engine.tombstones = Tombstones(engine.store, 0.0, engine.bell.ring)
        engine.delete_frame("attic", engine.list_frames("attic").items[0].frame_id)
        add("attic", [uploads[HALL + 2]])
    return house


@pytest.fixture(scope="session")
def copied(master):
    """A function that returns a writable copy of `master`."""

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
    """The answers of the undamaged `hall`."""
    return copied(tmp_path_factory.mktemp("truth") / "house").answers(uploads[:HALL])
