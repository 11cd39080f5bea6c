"""Tests of conflicting transactions, and of unusual server settings."""

import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing

import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.engine.ingest.write_groups import Grouping
from sceneprint.errors import StoreLocked
from sceneprint.store import open_database
from sceneprint.store.events import record_event
from sceneprint.store.keys import IdempotentRequest
from sceneprint.store.maps import add_map, store_model
from sceneprint.store.postgres import connection as postgres

MODEL = "ab" * 32


@pytest.fixture
def rows(server_store):
    with server_store.database.write() as connection:
        store_model(connection, MODEL, "toy", b"a model")
        return [add_map(connection, name, None, MODEL) for name in ("a", "b")]


def test_a_deadlock_of_two_costs_none_of_those_written_with_them(server_store, rows):
    """Two robots use the same two keys in another order, in groups of two maps."""
    database = server_store.database
    first, second = (IdempotentRequest("robot", key, "0" * 64) for key in ("1", "2"))
    both, tries = threading.Barrier(2), list[str]()

    def keep(request, meet=False):
        def work(connection):
            is_first = request.key not in tries
            tries.append(request.key)
            request.store(connection, {})
            if meet and is_first:
                both.wait(PATIENCE_S)
            return "kept"

        return work

    def innocent(connection):
        record_event(connection, "a", None, None)
        return "done"

    def run(group, work):
        try:
            return group.run(work)
        except StoreLocked:
            return "in the way"

    works = [
        (keep(first, meet=True), keep(second), innocent),
        (keep(second, meet=True), keep(first), innocent),
    ]
    groups = [Grouping(database, row.number) for row in rows]
    with ThreadPoolExecutor(6) as pool:
        found = []
        with database.write():  # until this is over nobody else writes
            for group, three in zip(groups, works, strict=True):
                for work in three:
                    before = len(group._waiting)
                    found.append(pool.submit(run, group, work))
                    while len(group._waiting) == before:
                        pass
        came = [one.result(PATIENCE_S) for one in found]
    assert [came[2], came[5]] == ["done", "done"]
    assert len(tries) > 4  # there was a deadlock, and those of one group were written again


@pytest.mark.parametrize("level", ["repeatable read", "serializable"])
def test_who_waited_for_its_turn_sees_what_was_committed_meanwhile(postgres, level):
    """Whatever the database's own level is: a remover would not see the frame that needs a blob."""
    url = postgres.create(f"level_{level.partition(' ')[0]}")
    postgres.execute(
        f"ALTER DATABASE level_{level.partition(' ')[0]} "
        f"SET default_transaction_isolation = '{level}'"
    )
    with closing(open_database(url)) as database:
        with database.write() as connection:
            store_model(connection, MODEL, "toy", b"a model")
            row = add_map(connection, "a", None, MODEL)
        for how in ({}, {"map_number": row.number}, {"turn": False}):
            with database.write(**how) as connection:
                said = connection.exec_driver_sql("SHOW transaction_isolation").scalar_one()
                assert said == "read committed"
        with database.read() as connection:
            said = connection.exec_driver_sql("SHOW transaction_isolation").scalar_one()
            assert said == "repeatable read"


def test_a_new_schema_is_looked_at_by_each_who_sent_the_one_of_before(
    server_store, rows, monkeypatch
):
    database = server_store.database
    database.guard_schema()

    def sign(row):
        with database.write(map_number=row.number, single=True) as connection:
            return bool(connection.exec_driver_sql("SELECT 1").scalar_one())

    assert sign(rows[0])
    with database.write() as connection:
        connection.exec_driver_sql("UPDATE alembic_version SET version_num = '9999'")
    both, look = threading.Barrier(2), postgres.KnownSchema.read

    def look_together(self, connection):
        both.wait(PATIENCE_S)  # both have sent the schema of before
        look(self, connection)

    monkeypatch.setattr(postgres.KnownSchema, "read", look_together)
    with ThreadPoolExecutor(2) as pool:
        assert list(pool.map(sign, rows)) == [True, True]


def test_a_prepared_statement_that_is_gone_is_told(server_store):
    """As behind a pooler that gives one connection to several clients."""
    with (
        pytest.raises(StoreLocked, match="A prepared statement no longer exists"),
        server_store.database.read() as connection,
    ):
        connection.exec_driver_sql("EXECUTE nothing")
