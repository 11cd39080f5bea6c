"""Tests of a store that a later version migrates while this version has it open."""

import re
from contextlib import closing
from secrets import token_hex

import pytest
from sqlalchemy import text

from sceneprint.cli import main
from sceneprint.errors import NewerSchema
from sceneprint.store import open_database
from sceneprint.store.database import SchemaRange, known_revisions, reach_database
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
    with closing(reach_database(url)) as found, found.read() as connection:
        names = connection.execute(text("SELECT map FROM events ORDER BY number")).scalars()
        assert list(names) == ["first", "second"]


def test_a_process_may_begin_on_a_later_schema_that_allows_it(url, store):
    assert store.database.dialect in url
    _set_schema(url, "9999", known_revisions()[0])
    open_database(url).close()
    assert _range(url)[0] == "9999"  # as it was


@pytest.mark.parametrize(
    ("revision", "least", "allowed"),
    [
        ("0015", "0015", True),
        ("0017", "0015", True),
        ("0017", "0016", False),
        ("0014", "0013", False),  # restored under the process: migrated when it is opened again
        ("from the future", "0015", False),
    ],
)
def test_which_processes_a_schema_allows(revision, least, allowed):
    assert SchemaRange(revision, least).allows("0015") is allowed


def _range(url):
    """Return the revision of a store, and the oldest one whose processes may write to it."""
    asked = text("SELECT version_num, least_revision FROM alembic_version, schema_range")
    with closing(reach_database(url)) as found, found.read() as connection:
        revision, least = connection.execute(asked).one()
        return revision, least


@pytest.fixture
def migrate_command(monkeypatch, capsys):
    """Exit code, output and error of `sceneprint migrate`.

    In this process: six that start take 6 s of processor time.
    """

    def run(url, folder, *options):
        monkeypatch.setenv("SCENEPRINT_DATABASE_URL", url)
        code = main(["migrate", "--data", f"{folder}", *options])
        said = capsys.readouterr()
        return code, said.out.strip(), said.err.strip()

    return run


@pytest.mark.parametrize("kind", ["sqlite", "postgresql"])
def test_the_command_makes_the_schema_once(kind, migrate_command, tmp_path, request):
    if kind == "sqlite":
        url = f"sqlite:///{tmp_path}/data/sceneprint.db"
    else:
        server = request.getfixturevalue("postgres")
        url = server.create(f"empty_{token_hex(4)}")
    head = known_revisions()[0]
    data = tmp_path / "data"
    code, said, _ = migrate_command(url, data, "--check")
    assert (code, said.endswith("schema none; run `sceneprint migrate`")) == (1, True)
    assert not data.exists()
    code, said, _ = migrate_command(url, data)
    assert (code, said.endswith(f"schema none -> {head}")) == (0, True)
    for options in ((), ("--check",)):
        code, said, _ = migrate_command(url, data, *options)
        assert (code, said.endswith(f"schema {head}")) == (0, True)
    _set_schema(url, "9999", head)  # later, and this version may still write to it
    code, said, _ = migrate_command(url, data, "--check")
    assert (code, said.endswith("schema 9999")) == (0, True)
    _set_schema(url, "9999", "9998")
    code, _, error = migrate_command(url, data)
    assert (code, "of a later version of sceneprint" in error) == (2, True)


def test_no_process_begins_on_a_later_schema_that_does_not_allow_it(url, store):
    assert store.database.dialect in url
    _set_schema(url, "9999", "9999")
    with pytest.raises(NewerSchema, match="has schema 9999 of a later version"):
        open_database(url)
    assert _range(url) == ("9999", "9999")
