"""Tests of transactions of one statement: one round trip, in order, and atomic."""

from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import pytest
from sqlalchemy import func, literal_column, select, text, update

from sceneprint.engine.ingest.uploads import Upload
from sceneprint.engine.ingest.write_groups import NewFrames
from sceneprint.errors import IdempotencyConflict, LostLease, NewerSchema
from sceneprint.settings import Settings
from sceneprint.store import open_database
from sceneprint.store.keys import IdempotentRequest
from sceneprint.store.maps import add_map, store_model
from sceneprint.store.postgres import connection as postgres
from sceneprint.store.tables import maps
from sceneprint_client.api import NewMap
from tests.whole_engine import Engine

MODEL = "ab" * 32
LOCKS_HELD = text(
    "SELECT count(*) FROM pg_locks WHERE locktype = 'advisory' AND granted "
    "AND database = (SELECT oid FROM pg_database WHERE datname = current_database())"
)


@pytest.fixture
def row(server_store):
    with server_store.database.write() as connection:
        store_model(connection, MODEL, "toy", b"a model")
        return add_map(connection, "hall", None, MODEL)


def edit(database, row, note, *, single=True):
    with database.write(map_number=row.number, single=single) as connection:
        connection.execute(update(maps).where(maps.c.number == row.number).values(name=note))


def named(store):
    with store.database.read() as connection:
        return str(connection.execute(select(maps.c.name)).scalar_one())


def locks(store):
    with store.database.read() as connection:
        return int(connection.execute(LOCKS_HELD).scalar_one())


@contextmanager
def held(store, row):
    """The map's turn, of another process; None: that of all maps."""
    with store.database._writers.begin() as other:
        postgres.take_turn(other, 10.0, None, None if row is None else row.number)
        yield other


def test_it_is_committed_with_its_answer_and_keeps_no_turn(server_store, row):
    database = server_store.database
    query = text(str(LOCKS_HELD).replace("count(*)", "mode") + " AND pid = pg_backend_pid()")
    with database.write(map_number=row.number, single=True) as connection:
        rows = connection.execute(query).scalars().all()  # it had its turn, and its map alone
        assert sorted(rows) == ["ExclusiveLock", "ShareLock"]
        assert locks(server_store) == 0
    with database.write(map_number=row.number, single=True) as connection:
        connection.execute(update(maps).values(name="at once"))
        assert named(server_store) == "at once"


def test_nothing_cuts_its_commit_off(server_store, row):
    """A commit may wait for a standby for longer than any statement may take."""
    query = text("SELECT current_setting('statement_timeout'), current_setting('lock_timeout')")
    with server_store.database.write(map_number=row.number, single=True) as connection:
        assert tuple(connection.execute(query).one()) == ("0", "10s")
    with server_store.database.read() as connection:  # and it is of that transaction alone
        assert connection.exec_driver_sql("SHOW statement_timeout").scalar_one() == "1min"


def test_it_sees_what_was_committed_while_its_turn_was_waited_for(
    server_store, row, until, waiting
):
    def late():
        with server_store.database.write(map_number=row.number, single=True) as connection:
            return connection.execute(select(maps.c.name)).scalar_one()

    with ThreadPoolExecutor(1) as pool, held(server_store, row) as other:
        writer = pool.submit(late)
        until(lambda: waiting(server_store) == 1)
        other.execute(update(maps).values(name="renamed"))
    assert writer.result() == "renamed"


@pytest.mark.parametrize("single", [True, False])
def test_who_waited_for_a_migration_writes_nothing(server_store, row, until, waiting, single):
    with ThreadPoolExecutor(1) as pool, held(server_store, None) as other:
        writer = pool.submit(edit, server_store.database, row, "late", single=single)
        until(lambda: waiting(server_store) == 1)
        other.exec_driver_sql("UPDATE alembic_version SET version_num = '9999'")
        other.exec_driver_sql("UPDATE schema_range SET least_revision = '9999'")
        other.exec_driver_sql("ALTER TABLE maps RENAME COLUMN name TO gone")  # it would fail, too
    with pytest.raises(NewerSchema, match="schema 9999"):
        writer.result()


def test_a_schema_that_went_on_and_may_be_written_to_is_noted(server_store, row):
    database = server_store.database
    edit(database, row, "before")
    with database.write() as connection:
        connection.exec_driver_sql("UPDATE alembic_version SET version_num = '9999'")
    for name in ("after", "later"):
        edit(database, row, name)
        assert named(server_store) == name
    with database.write() as connection:
        connection.exec_driver_sql("UPDATE schema_range SET least_revision = '9998'")
    with pytest.raises(NewerSchema, match="Nothing was stored"):
        edit(database, row, "too late")
    assert named(server_store) == "later"


def test_what_fails_leaves_nothing(server_store, row):
    database = server_store.database
    with (
        pytest.raises(Exception, match="division by zero"),
        database.write(map_number=row.number, single=True) as connection,
    ):
        connection.execute(update(maps).values(name="half", revision=literal_column("1 / 0")))
    assert named(server_store) == "hall"
    assert locks(server_store) == 0
    with database.write(map_number=row.number, single=True):
        pass  # no statement was sent, so no transaction has begun
    edit(database, row, "after")
    assert named(server_store) == "after"


def test_a_connection_that_was_ended_a_moment_ago_is_not_used(server_store, row):
    database = server_store.database
    with database.read() as connection:
        mine = connection.exec_driver_sql("SELECT pg_backend_pid()").scalar_one()
    other = open_database(database._engine.url.render_as_string(hide_password=False))
    with other.read() as connection:
        connection.execute(text("SELECT pg_terminate_backend(:pid, 60000)"), {"pid": mine})
    other.close()
    edit(database, row, "after")
    assert named(server_store) == "after"


@pytest.fixture
def engine(postgres_url, tmp_path):
    (tmp_path / "blobs").mkdir()
    settings = {"database_url": postgres_url, "data_dir": tmp_path}
    with Engine(Settings.model_validate(settings)) as opened:
        opened.create_map(NewMap(name="hall"))
        yield opened


def test_a_request_whose_key_is_used_meanwhile_takes_nothing(engine, small, monkeypatch):
    engine.create_map(NewMap(name="other"))
    run = NewFrames.receive
    keyed = {mark: IdempotentRequest("robot", "a key", mark * 64) for mark in "ab"}

    def overtaken(group, frame):
        monkeypatch.undo()
        engine.uploads.add("other", Upload(*small[1]), keyed["b"])
        return run(group, frame)

    monkeypatch.setattr(NewFrames, "receive", overtaken)
    with pytest.raises(IdempotencyConflict):
        engine.uploads.add("hall", Upload(*small[0]), keyed["a"])
    assert (engine.get_map("hall").frames, engine.get_map("other").frames) == ({}, {"received": 1})
    with engine.store.database.read() as connection:
        assert connection.execute(select(func.sum(maps.c.used_frames))).scalar() == 1
    assert len(list(engine.store.blobs.digests())) == 1


def test_what_has_a_fence_is_taken_behind_it(engine, small):
    def lost(_):
        raise LostLease("another worker has it")

    with pytest.raises(LostLease):
        engine.uploads.add_all("hall", [Upload(*small[0])], fence=lost)
    assert engine.get_map("hall").frames == {}
    assert list(engine.store.blobs.digests()) == []
