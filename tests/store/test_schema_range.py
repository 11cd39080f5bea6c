"""Tests of a store that a later version migrates while this version has it open."""

import re
from contextlib import closing
from secrets import token_hex

import pytest
from sqlalchemy import text

from sceneprint.errors import NewerSchema
from sceneprint.store import open_database
from sceneprint.store.database import known_revisions, reach_database
from sceneprint.store.events import record_event


def _set_schema(url, revision, least):
    """Let a store say that a migration of a later version ran."""
    with closing(reach_database(url)) as later, later.write() as connection:
        connection.execute(text("UPDATE alembic_version SET version_num = :v"), {"v": revision})
        connection.execute(text("UPDATE schema_range SET least_revision = :v"), {"v": least})


def test_an_old_process_writes_as_long_as_the_schema_allows_it(url, store):
    """Another process migrates the store that this one has open."""

    def write(name, turn=True):
        with store.database.write(turn=turn) as connection:
            record_event(connection, "map.edited", name)

    own = known_revisions()[0]
    write("first")
    _set_schema(url, "0098", own)
    write("second")
    _set_schema(url, "0099", "0098")
    said = (
        "was migrated to schema 0099 of a later version of sceneprint while this process, which "
        f"needs {own}, was running. Nothing was stored. Stop this process, and start the version "
        "of the other processes."
    )
    for turn in (True, False):
        with pytest.raises(NewerSchema, match=re.escape(said)):
            write("third", turn)
    with closing(reach_database(url)) as result, result.read() as connection:
        names = connection.execute(text("SELECT map FROM events ORDER BY number")).scalars()
        assert list(names) == ["first", "second"]


def test_a_process_may_begin_on_a_later_schema_that_allows_it(url, store):
    assert store.database.dialect in url
    _set_schema(url, "9999", known_revisions()[0])
    open_database(url).close()
    assert _range(url)[0] == "9999"  # as it was


def _range(url):
    """Return the revision of a store, and the oldest one whose processes may write to it."""
    query = text("SELECT version_num, least_revision FROM alembic_version, schema_range")
    with closing(reach_database(url)) as result, result.read() as connection:
        revision, least = connection.execute(query).one()
        return revision, least


@pytest.mark.parametrize("kind", ["sqlite", "postgresql"])
def test_the_command_makes_the_schema_once(kind, run_command, tmp_path, request, monkeypatch):
    if kind == "sqlite":
        url = f"sqlite:///{tmp_path}/data/sceneprint.db"
    else:
        url = request.getfixturevalue("postgres").create(f"empty_{token_hex(4)}")
    monkeypatch.setenv("SCENEPRINT_DATABASE_URL", url)
    head, migrate = known_revisions()[0], ("migrate", "--data", tmp_path / "data")

    def printed(*options, expect=0):
        return run_command(*migrate, *options, expect=expect).stdout.strip()

    assert printed("--check", expect=1).endswith("schema none; run `sceneprint migrate`")
    assert not (tmp_path / "data").exists()
    assert printed().endswith(f"schema none -> {head}")
    for options in ((), ("--check",)):
        assert printed(*options).endswith(f"schema {head}")
    _set_schema(url, "9999", head)  # later, and this version may still write to it
    assert printed("--check").endswith("schema 9999")
    _set_schema(url, "9999", "9998")
    error = run_command(*migrate, expect=2).stderr
    assert "of a later version of sceneprint" in error


def test_no_process_begins_on_a_later_schema_that_does_not_allow_it(url, store):
    assert store.database.dialect in url
    _set_schema(url, "9999", "9999")
    with pytest.raises(NewerSchema, match="has schema 9999 of a later version"):
        open_database(url)
    assert _range(url) == ("9999", "9999")
