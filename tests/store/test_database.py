"""Tests of the schema, of rejected databases, and of transactions."""

import resource
import sqlite3
import subprocess
import sys
from contextlib import closing

import pytest
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory

from sceneprint.errors import UnusableStore
from sceneprint.store import open_database
from sceneprint.store.database import known_revisions, migration_config, revision_of
from sceneprint.store.tables import metadata
from tests.store.conftest import SCHEMA_OF


@pytest.mark.sqlite_only("a file")
def test_four_processes_may_migrate_one_empty_database_at_once(url, tmp_path, race):
    assert race(SCHEMA_OF, 4, url) == [[known_revisions()[0]]] * 4
    with closing(sqlite3.connect(tmp_path / "truth.db")) as connection:
        assert connection.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
        names = connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'").fetchall()
    assert sorted(name for (name,) in names) == sorted(
        ["alembic_version", *metadata.tables, "sqlite_sequence"]
    )


@pytest.mark.sqlite_only("a file")
def test_a_file_that_is_no_database_is_left_as_it_is(url, tmp_path):
    path = tmp_path / "truth.db"
    path.write_bytes(b"my notes about the warehouse\n" * 400)
    with pytest.raises(UnusableStore, match=r"not a database\. Restore the data folder"):
        open_database(url)
    assert path.read_bytes() == b"my notes about the warehouse\n" * 400


@pytest.mark.sqlite_only("a file")
def test_a_damaged_page_is_said(url, store, tmp_path):
    store.database.close()
    path = tmp_path / "truth.db"
    data = bytearray(path.read_bytes())
    data[4096:] = bytes(len(data) - 4096)
    path.write_bytes(data)
    with pytest.raises(UnusableStore, match=r"malformed\. Restore the data folder from a copy"):
        open_database(url)


def test_the_revisions_are_those_that_alembic_sees(store):
    scripts = ScriptDirectory.from_config(migration_config())
    every = {revision.revision for revision in scripts.walk_revisions()}
    assert known_revisions() == (scripts.get_current_head(), every)
    with store.database.read() as connection:
        context = MigrationContext.configure(connection)
        assert revision_of(connection) == context.get_current_revision() == known_revisions()[0]


#: Largest file of the child, in pages of the database: less than the schema takes.
PAGES = 4
OPENS = """
import sys
from sceneprint.errors import UnusableStore
from sceneprint.store import open_database
try:
    open_database(sys.argv[1]).close()
    print("opened")
except UnusableStore as error:
    print(error)
"""


def narrow():
    """For a child about to begin: its files stay small, as on a disk that is full."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096 * PAGES, 4096 * PAGES))


def schema(path):
    with closing(sqlite3.connect(path)) as connection:
        assert connection.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        return set(connection.execute("SELECT name, sql FROM sqlite_master").fetchall())


def test_a_schema_that_finds_no_room_changes_nothing(tmp_path):
    path = tmp_path / "truth.db"
    url = f"sqlite:///{path}"
    result = schema(path)
    done = subprocess.run(
        [sys.executable, "-c", OPENS, url], capture_output=True, text=True, check=True,
        preexec_fn=narrow,
    )  # fmt: skip
    assert "that the disk has free space" in done.stdout
    assert schema(path) == result
    open_database(url).close()  # and with room it goes on
    assert len(schema(path)) > len(result)
