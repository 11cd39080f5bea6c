"""Tests of a database server: schema, locks, readers, statements that SQLite lacks, and faults."""

import json
import threading
from contextlib import ExitStack

import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from sqlalchemy import insert, select, text
from sqlalchemy.exc import DBAPIError

from sceneprint import errors
from sceneprint.errors import StoreLocked, UnusableStore
from sceneprint.store import database, open_database, open_store
from sceneprint.store.database import database_exists, known_revisions, reach_database
from sceneprint.store.events import record_event
from sceneprint.store.maps import add_map, frames_of, list_maps, store_model
from sceneprint.store.postgres import connection as postgres
from sceneprint.store.read_only import inspect_database
from sceneprint.store.tables import events, maps, metadata
from tests.store.conftest import SCHEMA_OF


@pytest.fixture
def empty_url(postgres):
    """A database without any table."""
    yield postgres.create("bare")
    postgres.drop("bare")


@pytest.fixture
def served(postgres_url):
    opened = open_database(postgres_url)
    yield opened
    opened.close()


@pytest.fixture
def keeper(postgres_url):
    """Who has the turn, as another process would: over connections of its own. Ends it."""
    other = reach_database(postgres_url)
    with ExitStack() as held:
        held.enter_context(other.write())
        yield held.close
    other.close()


def test_two_processes_may_open_an_empty_database_at_once(empty_url, race):
    assert not database_exists(empty_url)
    assert race(SCHEMA_OF, 2, empty_url) == [[known_revisions()[0]]] * 2
    assert database_exists(empty_url)
    database = open_database(empty_url)
    with database.read() as connection:
        context = MigrationContext.configure(connection, opts={"compare_type": True})
        assert compare_metadata(context, metadata) == []
        narrow = text(
            "SELECT table_name, column_name FROM information_schema.columns WHERE table_schema = "
            "'public' AND table_name <> 'alembic_version' AND (data_type = 'integer' OR (data_type "
            "IN ('text', 'character varying') AND collation_name IS DISTINCT FROM 'C'))"
        )
        assert connection.execute(narrow).all() == []
        counted = connection.execute(text("SELECT DISTINCT data_type::text FROM pg_sequences"))
        assert counted.scalars().all() == ["bigint"]
    database.close()


def test_the_blobs_of_a_database_that_is_there_are_not_made_up_for(
    postgres_url, empty_url, tmp_path
):
    new = open_store(empty_url, tmp_path / "new" / "blobs")
    new.blobs.put(b"upload")
    new.database.close()
    assert (tmp_path / "new" / "blobs").is_dir()
    old = open_store(postgres_url, tmp_path / "old" / "blobs")
    with pytest.raises(UnusableStore, match="No such file or directory"):
        old.blobs.put(b"upload")
    old.database.close()
    assert not (tmp_path / "old").exists()


def test_a_turn_that_another_process_keeps_is_said(served, keeper, monkeypatch):
    monkeypatch.setattr(database, "BUSY_S", 0.2)
    monkeypatch.setattr(postgres, "HELD_S", 0.2)
    for _ in range(2):  # the second, who comes after one that waited in vain, waits less
        with (
            pytest.raises(StoreLocked, match=r"Nothing was stored\. Try again.*pg_stat_activity"),
            served.write(),
        ):
            pytest.fail("it is not our turn")
    with served.read() as connection:  # readers wait for nobody
        assert list_maps(connection) == []
    with served.write(turn=False) as connection:  # nor does who needs no turn
        connection.execute(insert(events).values(at=0.0, kind="x", data={}))
    keeper()
    with served.write() as connection:
        assert connection.execute(text("SHOW lock_timeout")).scalar() == "10s"
        assert connection.execute(select(events.c.kind)).scalars().all() == ["x"]


def test_a_migration_waits_for_its_turn_longer_than_a_writer(served, keeper, monkeypatch):
    monkeypatch.setattr(database, "BUSY_S", 0.05)
    with pytest.raises(StoreLocked), served.write():
        pytest.fail("it is not our turn")
    soon = threading.Timer(0.5, keeper)
    soon.start()
    with served.write(unchecked=True) as connection:
        for name in ("statement_timeout", "lock_timeout", "idle_in_transaction_session_timeout"):
            assert connection.execute(text(f"SHOW {name}")).scalar() == "0"
    soon.join()
    with served.write() as connection:  # on the same connection, for the next
        assert connection.execute(text("SHOW lock_timeout")).scalar() == "10s"


def test_a_reader_sees_one_state_and_writes_nothing(served):
    with ExitStack() as stack:
        held = [stack.enter_context(served.read()) for _ in range(3)]
        for connection in held:
            shown = [
                connection.execute(text(f"SHOW {name}")).scalar()
                for name in ("transaction_isolation", "transaction_read_only", "lock_timeout",
                             "statement_timeout", "idle_in_transaction_session_timeout",
                             "application_name", "tcp_keepalives_idle",
                             "tcp_keepalives_interval", "tcp_keepalives_count")
            ]  # fmt: skip
            assert shown[:6] == ["repeatable read", "on", "10s", "1min", "30s", "sceneprint"]
            assert shown[6:] == ["3", "2", "3"]
        before = {one.execute(text("SELECT pg_backend_pid()")).scalar_one() for one in held}
    with pytest.raises(UnusableStore, match="read-only transaction"), served.read() as connection:
        store_model(connection, "m", "toy", b"x")
    with served.read(), served.read(), served.write() as connection:
        # as if it were a standby: connections made anew may lead to the one that writes
        assert connection.execute(text("SELECT pg_backend_pid()")).scalar_one() not in before
        assert connection.execute(text("SHOW transaction_read_only")).scalar() == "off"
        assert connection.execute(text("SHOW transaction_isolation")).scalar() == "read committed"


@pytest.mark.parametrize(
    ("set_to", "found"), [("off", "on"), ("local", "local"), ("remote_apply", "remote_apply")]
)
def test_a_commit_is_never_acknowledged_before_it_is_on_disk(postgres, postgres_url, set_to, found):
    name = postgres_url.rpartition("/")[2]
    postgres.execute(f"ALTER DATABASE {name} SET synchronous_commit = {set_to}")
    opened = open_database(postgres_url)
    with opened.read() as connection:
        assert connection.execute(text("SHOW synchronous_commit")).scalar() == found
    opened.close()


def test_more_readers_than_connections_are_told_so(postgres_url, monkeypatch):
    for name, value in (("IDLE_CONNECTIONS", 1), ("MOST", 2), ("BUSY_S", 0.1)):
        monkeypatch.setattr(postgres, name, value)
    few = reach_database(postgres_url)
    with few.read(), few.read(), pytest.raises(StoreLocked, match="All connections"), few.read():
        pytest.fail("there are two")
    with few.read() as connection:
        assert list_maps(connection) == []
    few.close()


def test_a_text_with_nul_is_found_nowhere_and_noted_all_the_same(store):
    with store.database.write() as connection:
        store_model(connection, "m", "n" * 200, b"x")
        add_map(connection, "hall", None, "m")
        assert [row.name for row in list_maps(connection)] == ["hall"]
        rows = connection.execute(select(maps.c.number).where(maps.c.name == "hall\0"))
        assert rows.all() == []


def test_more_numbers_are_asked_for_than_one_statement_takes(store, hall, received):
    numbers = [received(name).number for name in "abc"]
    with store.database.read() as connection:
        result = frames_of(connection, range(70_000))
    assert sorted(result) == numbers


def test_what_was_stored_is_json(store, hall):
    """Not of PostgreSQL's other kind, which sorts keys and knows no escaped NUL."""
    data = {"b": 1, "a": ["\0", "\ud800", 1e300, None]}
    with store.database.write() as connection:
        record_event(connection, "map.edited", "hall", **data)
        (rows,) = connection.execute(select(events.c.data).where(events.c.kind == "map.edited"))
    assert json.dumps(rows[0]) == json.dumps(data)


@pytest.mark.parametrize(
    ("state", "kind", "said"),
    [
        ("55P03", errors.StoreLocked, "Another process has been writing for too long"),
        ("40001", errors.StoreLocked, "The transaction conflicted with another"),
        ("40P01", errors.StoreLocked, "The transaction conflicted with another"),
        ("26000", errors.StoreLocked, "A prepared statement no longer exists"),
        ("53100", errors.StoreFull, "Free some space on the disk of the server"),
        ("53200", errors.UnusableStore, "Check its log"),
        ("53300", errors.StoreAway, "max_connections"),
        ("25006", errors.ReadOnlyStore, "target_session_attrs=read-write"),
        ("25P03", errors.UnusableStore, "was idle for too long"),
        ("57014", errors.UnusableStore, "took too long"),
        ("57P01", errors.StoreAway, "service tries again"),
        ("08006", errors.StoreAway, "service tries again"),
        ("28P01", errors.UnusableStore, "Check user and password"),
        ("42501", errors.UnusableStore, "Make it their owner"),
        ("58030", errors.UnusableStore, "cannot use its files"),
        ("XX001", errors.UnusableStore, "Restore a bundle"),
    ],
)
def test_a_fault_is_of_its_kind_and_leaves_nothing(served, state, kind, said):
    def go_wrong(connection):
        connection.execute(text("INSERT INTO models VALUES ('m', 'toy', 'x', 1.0)"))
        raised = f"DO $$ BEGIN RAISE EXCEPTION 'so it is' USING ERRCODE = '{state}'; END $$"
        connection.exec_driver_sql(raised)

    with pytest.raises(errors.UnusableStore, match=said) as caught, served.write() as connection:
        go_wrong(connection)
    assert type(caught.value) is kind
    assert str(caught.value).startswith(f"{served.shown}: so it is")
    with served.write() as connection:
        assert connection.execute(text("SELECT count(*) FROM models")).scalar() == 0


def test_a_mistake_of_ours_stays_one(served):
    for wrong in ("SELECT nothing", "SELEC", "SELECT 1/0", "SELECT 'x'::int"):
        with pytest.raises(DBAPIError), served.read() as connection:
            connection.exec_driver_sql(wrong)


@pytest.mark.parametrize(
    ("value", "kind", "said"),
    [
        ("postgresql://u:hunter2@127.0.0.1:{port}/none", errors.UnusableStore, "does not exist"),
        ("postgres://none:hunter2@127.0.0.1:{port}/postgres", errors.UnusableStore, "user"),
        ("postgresql+psycopg://u:hunter2@127.0.0.1:1/x", errors.StoreAway, "service tries again"),
        ("postgresql://u:hunt@er2@127.0.0.1/x", errors.UnusableStore, "%40"),
        ("postgresql://127.0.0.1:{port}/x?user=u&password=hunter2&at=er2",
         errors.UnusableStore, "Correct"),
        ("postgresql://u:hunter2@127.0.0.1/x?connect_timeout=soon",
         errors.UnusableStore, "Correct"),
        ("postgresql+asyncpg://u:hunter2@127.0.0.1/x", errors.UnusableStore, r"\+psycopg"),
        ("mysql://u:hunter2@127.0.0.1/x", errors.UnusableStore, "is not a supported database"),
    ],
)  # fmt: skip
def test_what_cannot_be_reached_is_said_without_the_password(
    postgres, value, kind, said, monkeypatch
):
    monkeypatch.setenv("PGHOST", "/nowhere")
    port = postgres.url().rpartition(":")[2].partition("/")[0]
    for use in (open_database, database_exists, _looked_at):
        if use is database_exists and "Correct" not in said and "exist" not in said:
            continue  # it is asked before the database is opened, which says why
        with pytest.raises(errors.UnusableStore, match=said) as caught:
            use(value.format(port=port))
        assert "hunter2" not in str(caught.value)
        assert "er2" not in str(caught.value)
        assert isinstance(caught.value, kind)


def _looked_at(url):
    with inspect_database(url):
        pass


def test_a_database_of_another_encoding_is_refused(postgres):
    postgres.execute(
        "CREATE DATABASE ascii ENCODING 'SQL_ASCII' LC_COLLATE 'C' LC_CTYPE 'C' TEMPLATE template0"
    )
    with pytest.raises(errors.UnusableStore, match=r"encoding SQL_ASCII.*ENCODING 'UTF8'"):
        open_database(postgres.url("ascii"))
    postgres.drop("ascii")


def test_a_server_that_is_not_there_is_not_asked_before_it_must():
    far = reach_database("postgresql://u:hunter2@127.0.0.1:1/x?host=a:1&host=b:2")
    assert far.shown == "postgresql://u@127.0.0.1:1/x"
    assert "hunter2" not in repr(far.shown)
    several = reach_database("postgresql://u:hunter2@/x?host=a:5432&host=b&password=hunter2")
    assert several.shown == "postgresql://u@a:5432,b/x"
    far.close()
    several.close()
