"""Tests of the errors for server faults, which never contain the password."""

import pytest
from sqlalchemy import select, text
from sqlalchemy.exc import DBAPIError

from sceneprint import errors
from sceneprint.store import open_database
from sceneprint.store.database import database_exists, reach_database
from sceneprint.store.read_only import inspect_database
from sceneprint.store.tables import maps


@pytest.fixture
def served(postgres_url):
    opened = open_database(postgres_url)
    yield opened
    opened.close()


@pytest.mark.parametrize(
    ("state", "kind", "said"),
    [
        ("55P03", errors.StoreLocked, "Another process has been writing for too long"),
        ("40001", errors.StoreLocked, "The transaction conflicted with another"),
        ("40P01", errors.StoreLocked, "The transaction conflicted with another"),
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


def test_a_statement_without_end_is_ended(served):
    def sleep(connection):
        connection.exec_driver_sql("SET LOCAL statement_timeout = 50")
        connection.exec_driver_sql("SELECT pg_sleep(600)")

    with pytest.raises(errors.UnusableStore, match="took too long"), served.read() as connection:
        sleep(connection)
    with served.read() as connection:
        assert connection.execute(select(maps)).all() == []


def test_connections_that_were_ended_are_made_anew(served, postgres):
    def fall(connection):
        mine = connection.execute(text("SELECT pg_backend_pid()")).scalar_one()
        postgres.execute(f"SELECT pg_terminate_backend({mine}, 60000)")
        connection.execute(select(maps))

    with pytest.raises(errors.StoreAway), served.write() as connection:
        fall(connection)
    with served.read() as first, served.read() as second:
        pids = [
            one.execute(text("SELECT pg_backend_pid()")).scalar_one() for one in (first, second)
        ]
    for pid in pids:  # while nobody uses them: whoever comes next learns nothing of it
        postgres.execute(f"SELECT pg_terminate_backend({pid}, 60000)")
    with served.write() as first, served.read() as second:
        assert first.execute(select(maps)).all() == second.execute(select(maps)).all() == []


@pytest.mark.parametrize(
    ("given", "kind", "said"),
    [
        ("postgresql://u:hunter2@127.0.0.1:{port}/none", errors.UnusableStore, "does not exist"),
        ("postgres://none:hunter2@127.0.0.1:{port}/postgres", errors.UnusableStore, "user"),
        ("postgresql+psycopg://u:hunter2@127.0.0.1:1/x", errors.StoreAway, "service tries again"),
        ("postgresql://u:hunt@er2@127.0.0.1/x", errors.UnusableStore, "%40"),
        ("postgresql://u:hunt@127.0.0.1:er2/x", errors.UnusableStore, "%40"),
        ("postgresql://127.0.0.1:{port}/x?user=u&password=hunter2&at=er2",
         errors.UnusableStore, "Correct"),
        ("postgresql://127.0.0.1:{port}/x?user=u&password=hunter2",
         errors.UnusableStore, "does not exist"),
        ("postgresql://u:hunter2@127.0.0.1/x?connect_timeout=soon",
         errors.UnusableStore, "Correct"),
        ("postgresql+asyncpg://u:hunter2@127.0.0.1/x", errors.UnusableStore, r"\+psycopg"),
        ("postgresql+psycopg2://u:hunter2@127.0.0.1/x", errors.UnusableStore, r"\+psycopg"),
        ("mysql://u:hunter2@127.0.0.1/x", errors.UnusableStore, "is not a supported database"),
    ],
)  # fmt: skip
def test_what_cannot_be_reached_is_said_without_the_password(
    postgres, given, kind, said, monkeypatch
):
    monkeypatch.setenv("PGHOST", "/nowhere")
    port = postgres.url().rpartition(":")[2].partition("/")[0]
    for use in (open_database, database_exists, _looked_at):
        if use is database_exists and "Correct" not in said and "exist" not in said:
            continue  # it is asked before the database is opened, which says why
        with pytest.raises(errors.UnusableStore, match=said) as caught:
            use(given.format(port=port))
        assert "hunter2" not in str(caught.value)
        assert "er2" not in str(caught.value)
        assert isinstance(caught.value, kind)


def _looked_at(url):
    with inspect_database(url):
        pass


def test_a_table_that_is_changed_elsewhere_costs_one_try(served, postgres, postgres_url):
    """Connections have prepared for it what they asked of it again and again."""
    name, asked = postgres_url.rpartition("/")[2], text("SELECT a FROM changing")
    postgres.execute("CREATE TABLE changing (a int)", name)
    for _ in range(8):
        with served.write(turn=False) as one, served.write(turn=False) as other:
            assert [one.execute(asked).all(), other.execute(asked).all()] == [[], []]
    postgres.execute("ALTER TABLE changing ALTER a TYPE bigint", name)
    with (
        pytest.raises(errors.StoreLocked, match="The tables were changed meanwhile"),
        served.write(turn=False) as one,
    ):
        one.execute(asked)
    with served.write(turn=False) as one, served.write(turn=False) as other:
        assert [one.execute(asked).all(), other.execute(asked).all()] == [[], []]


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
