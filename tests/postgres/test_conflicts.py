"""Tests of conflicting transactions, and of unusual server settings."""

import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing

import pytest
from sqlalchemy import text

from benchmarks.waiting import PATIENCE_S
from sceneprint.engine.ingest.write_groups import Grouping
from sceneprint.errors import StoreLocked
from sceneprint.store import open_database, open_store
from sceneprint.store.deletion import doom, doomed_blobs
from sceneprint.store.events import record_event
from sceneprint.store.keys import IdempotentRequest
from sceneprint.store.maps import add_map, store_model
from sceneprint.store.postgres.connection import take_turn

MODEL = "ab" * 32


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
    groups = [Grouping(database, row.number) for row in rows[:2]]
    with ThreadPoolExecutor(6) as pool:
        results = []
        with database.write():  # until this is over nobody else writes
            for group, three in zip(groups, works, strict=True):
                for work in three:
                    before = len(group._waiting)
                    results.append(pool.submit(run, group, work))
                    while len(group._waiting) == before:
                        pass
        came = [result.result(PATIENCE_S) for result in results]
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


@pytest.mark.parametrize(
    ("wait_s", "after"), [(0.1, ("10s", "0")), (10.0, ("10s", "0")), (60.0, ("0", "0"))]
)
def test_a_turn_answers_the_last_question_and_leaves_the_usual_limits(server_store, wait_s, after):
    limits = "SELECT current_setting('lock_timeout'), current_setting('statement_timeout')"
    engine = server_store.database._writers
    with engine.begin() as connection:
        assert tuple(take_turn(connection, wait_s, "SELECT 7, 'x'")) == (7, "x")
        assert tuple(connection.exec_driver_sql(limits).one()) == after
    with engine.begin() as connection:
        assert tuple(connection.exec_driver_sql(limits).one()) == ("10s", "1min")


def test_writers_of_two_maps_may_doom_the_same_blobs(server_store, postgres_url, tmp_path, until):
    blobs = [f"{number:064x}" for number in range(3)]
    waits = text("SELECT 1 FROM pg_locks WHERE locktype = 'transactionid' AND NOT granted")

    def waiting():
        with server_store.database.read() as connection:
            return connection.execute(waits).all()

    def doom_elsewhere():
        with (
            closing(open_store(postgres_url, tmp_path / "blobs")) as other,
            other.database.write(map_number=8) as connection,
        ):
            doom(connection, blobs)

    with ThreadPoolExecutor(1) as pool, server_store.database.write(map_number=7) as connection:
        doom(connection, blobs[:2])
        writer = pool.submit(doom_elsewhere)
        until(waiting)
    writer.result()
    with server_store.database.read() as connection:
        assert doomed_blobs(connection, 9) == blobs
