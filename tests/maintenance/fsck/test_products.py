"""Tests of a backup of all products, and of the check of a fleet whose server is away."""

import time

import numpy as np
import pytest
from pydantic import SecretStr

from sceneprint.bundle.backup import take_backup
from sceneprint.bundle.restoration import restore_to_folder, restore_to_server
from sceneprint.errors import StoreAway
from sceneprint.formats.depth_file import encode_png
from sceneprint.maintenance.fsck.check import fsck
from sceneprint.settings import Settings
from sceneprint.store.query_rows import (
    NewQuery,
    WantedQueries,
    add_queries,
    keep_answer,
    list_queries,
    read_permanent_answer,
)
from sceneprint.store.queue import files_of, find_job
from sceneprint_client.api import CameraIntrinsics, FrameMeta, NewMap
from tests.maintenance.fsck.conftest import add_products
from tests.whole_engine import Engine


def query_of(letter, *, listed=True):
    return NewQuery(
        id=letter * 32, at=time.time(), map="hall", maps=None, robot=None, session=None,
        status="found", cause=None, reason="", pose_parent=None, pose=None, confidence=None,
        support=None, alternatives=0, milliseconds=1.0, kind=None, frame_map=None,
        frame_id=None, key_id=None, listed=listed, bytes=9,
    )  # fmt: skip


def fill(engine):
    """Add something of each kind; ids of the job, and of a deletion that can be undone."""
    engine.create_map(NewMap(name="hall", model="depth"))
    job_id, _ = add_products(engine)
    lens = CameraIntrinsics(width=64, height=48, fx=60, fy=60, cx=32, cy=24)
    png = encode_png(np.full((48, 64), 2000, np.uint16))
    frame, _ = engine.add_frame("hall", png, FrameMeta(intrinsics=lens, robot="r1"))
    with engine.store.database.write() as connection:
        add_queries(connection, [query_of("a"), query_of("b"), query_of("c", listed=False)])
        keep_answer(connection, 1, b"an answer", 1.0)
    engine.delete_frame("hall", frame.frame_id)
    (actual,) = engine.tombstones.list_all("hall", None, 9).items
    return job_id, actual.deletion_id


@pytest.mark.sqlite_only("restores to a database of its own in the folder")
def test_a_backup_has_all_that_is_kept_and_can_be_restored(tmp_path):
    settings = Settings(data_dir=tmp_path / "data", database_url=None)
    with Engine(settings) as engine:
        job_id, deletion = fill(engine)
    assert list(fsck(settings, grace_s=0)) == []
    take_backup(settings, str(tmp_path / "all"))
    restore_to_folder(str(tmp_path / "all"), tmp_path / "again")
    again = Settings(data_dir=tmp_path / "again", database_url=None)
    assert list(fsck(again, grace_s=0)) == []
    with Engine(again) as engine:
        with engine.store.database.read() as connection:
            files = files_of(connection, find_job(connection, job_id).number)
            assert engine.store.blobs.get(files["mesh.ply"].blob) == b"a mesh"
            rows = list_queries(connection, WantedQueries(), None, 9)
            assert [(row.id[0], row.kept_at, row.bytes) for row in rows] == [
                ("b", None, 0), ("a", 1.0, 9)
            ]  # fmt: skip
            assert read_permanent_answer(connection, rows[1].number) == b"an answer"
            count = connection.exec_driver_sql("SELECT count(*) FROM queries").scalar_one()
            assert count == 2  # not the one that was stored only to look at its answer
        assert engine.tombstones.restore("hall", deletion).frames == 1
        assert [frame.robot for frame in engine.list_frames("hall").items] == ["r1"]
    assert list(fsck(again, grace_s=0)) == []


@pytest.fixture(scope="session")
def bundles(copied, tmp_path_factory):
    place = tmp_path_factory.mktemp("bundles")
    # of a copy: SQLite leaves an empty log beside what it has only read
    take_backup(copied(place / "house").settings, str(place / "bundles"))
    return str(place / "bundles")


@pytest.fixture
def fleet(bundles, master, house_at, postgres_url, tmp_path):
    node = house_at(tmp_path / "node", SecretStr(postgres_url), master.settings.cache_dir)
    restore_to_server(bundles, node.settings)
    return node


@pytest.mark.sqlite_only("has a server of its own")
def test_a_server_that_is_away_is_no_damage(fleet, postgres):
    fleet.sql("UPDATE maps SET used_bytes = used_bytes - 1 WHERE name = 'hall'")
    seen = fsck(fleet.settings)
    assert next(seen).kind == "stale-value"  # the next check finds the connections gone
    name = fleet.settings.database.rsplit("/")[-1]
    postgres.execute(f"ALTER DATABASE {name} ALLOW_CONNECTIONS false")
    postgres.execute(
        "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE application_name='sceneprint'"
    )
    with pytest.raises(StoreAway):
        list(seen)
