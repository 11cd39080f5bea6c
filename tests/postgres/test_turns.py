"""Tests of a writer's lock on PostgreSQL: visible data, and cost."""

import threading

import pytest
from sqlalchemy import func, insert, select, text

from benchmarks.waiting import PATIENCE_S
from sceneprint.errors import NewerSchema, StoreLocked
from sceneprint.store.postgres import connection as postgres
from sceneprint.store.tables import events

#: Writers of other processes that wait for the turn.
_WAITING = text(
    "SELECT count(*) FROM pg_locks WHERE locktype = 'advisory' AND NOT granted "
    "AND database = (SELECT oid FROM pg_database WHERE datname = current_database())"
)


def waiting(store):
    with store.database.read() as connection:
        return int(connection.execute(_WAITING).scalar_one())


def write(store):
    with store.database.write() as connection:
        connection.execute(insert(events).values(at=0.0, kind="late", data={}))


def test_who_waited_for_a_migration_finds_its_schema_and_writes_nothing(server_store, until):
    raised = list[Exception]()

    def late():
        try:
            write(server_store)
        except NewerSchema as error:
            raised.append(error)

    writer = threading.Thread(target=late)
    with server_store.database._writers.begin() as other:  # as another process would
        postgres.take_turn(other, 10.0)
        writer.start()
        until(lambda: waiting(server_store) == 1)
        other.exec_driver_sql("UPDATE alembic_version SET version_num = '9999'")
        other.exec_driver_sql("UPDATE schema_range SET least_revision = '9999'")
    writer.join(PATIENCE_S)
    assert [str(one).partition("schema ")[2][:4] for one in raised] == ["9999"]
    with server_store.database.read() as connection:
        late_ones = select(func.count()).where(events.c.kind == "late")
        assert connection.execute(late_ones).scalar_one() == 0


@pytest.mark.parametrize(
    ("wait_s", "after"), [(0.1, ("10s", "0")), (10.0, ("10s", "0")), (60.0, ("0", "0"))]
)
def test_a_turn_answers_the_last_question_and_leaves_the_usual_limits(server_store, wait_s, after):
    limits = "SELECT current_setting('lock_timeout'), current_setting('statement_timeout')"
    engine = server_store.database._writers
    with engine.begin() as connection:
        assert tuple(postgres.take_turn(connection, wait_s, "SELECT 7, 'x'")) == (7, "x")
        assert tuple(connection.exec_driver_sql(limits).one()) == after
    with engine.begin() as connection:
        assert tuple(connection.exec_driver_sql(limits).one()) == ("10s", "1min")


def test_a_turn_that_does_not_come_in_time_is_an_error_and_is_given_up(server_store):
    database = server_store.database
    with database._writers.begin() as other:
        postgres.take_turn(other, 10.0)
        database._held = True  # as after a wait in vain: two seconds are enough
        with pytest.raises(StoreLocked):
            write(server_store)
        assert waiting(server_store) == 0
    write(server_store)
    with database.read() as connection:
        late_ones = select(func.count()).where(events.c.kind == "late")
        assert connection.execute(late_ones).scalar_one() == 1
