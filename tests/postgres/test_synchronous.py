"""Tests that a commit counts only once its standby has it."""

import threading
from concurrent.futures import ThreadPoolExecutor

import psycopg
import pytest
from sqlalchemy import text

from benchmarks.waiting import PATIENCE_S
from sceneprint.errors import StoreAway
from sceneprint.store.events import EventFilter, list_events, record_event

WAITING = "FROM pg_stat_activity WHERE wait_event = 'SyncRep'"


def waits_for_standby(server):
    """Return whether a commit waits for a standby; its wait is ended."""
    url = server.url("postgres").replace("+psycopg", "")

    def commit():
        with psycopg.connect(url, autocommit=True) as connection:
            connection.execute("CREATE TEMP TABLE probe ()")

    thread = threading.Thread(target=commit, daemon=True)
    thread.start()
    while thread.is_alive():
        if server.execute(f"SELECT pg_cancel_backend(pid) {WAITING}"):
            thread.join(PATIENCE_S)
            return True
    return False


@pytest.fixture
def forsaken(postgres, until):
    """A server whose standby is away."""
    for statement in ("ALTER SYSTEM SET synchronous_standby_names = 'nobody'",
                      "SELECT pg_reload_conf()"):  # fmt: skip
        postgres.execute(statement)
    until(lambda: waits_for_standby(postgres))  # the server reads its settings a little later
    yield postgres
    postgres.execute("ALTER SYSTEM RESET synchronous_standby_names")
    postgres.execute("SELECT pg_reload_conf()")


def test_a_commit_whose_wait_is_ended_by_hand_is_not_acknowledged(server_store, forsaken, until):
    database = server_store.database

    def write():
        with database.write() as connection:
            limit = connection.execute(text("SHOW statement_timeout")).scalar_one()
            assert limit == "0"  # else the server would end the wait itself
            record_event(connection, "map.created", "hall")

    pool = ThreadPoolExecutor(1)
    writer = pool.submit(write)
    until(lambda: forsaken.execute(f"SELECT 1 {WAITING}"))
    with database.read() as connection:  # others go on reading, and see nothing of it
        assert list_events(connection, EventFilter(), after=0, limit=9) == []

    def is_ended():  # the first wait may have been that of another connection
        forsaken.execute(f"SELECT pg_cancel_backend(pid) {WAITING}")
        return writer.done()

    until(is_ended)
    with pytest.raises(StoreAway, match="An operator ended the wait for a standby"):
        writer.result()  # it may be stored
    pool.shutdown()


def test_other_warnings_are_no_doubt(server_store):
    with server_store.database.write() as connection:
        connection.execute(text("DO $$ BEGIN RAISE WARNING 'of something else'; END $$"))
        record_event(connection, "map.created", "hall")
    with server_store.database.read() as connection:
        assert len(list_events(connection, EventFilter(), after=0, limit=9)) == 1
        assert connection.execute(text("SHOW statement_timeout")).scalar_one() == "1min"
