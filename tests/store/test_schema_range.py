"""Tests of a store that a later version migrates while this version has it open."""

import shutil
import subprocess
import sys
from contextlib import closing
from pathlib import Path
from secrets import token_hex

import pytest
from sqlalchemy import text

import migrations
from sceneprint.cli import main
from sceneprint.errors import NewerSchema
from sceneprint.store import database, open_database
from sceneprint.store.database import SchemaRange, known_revisions, reach_database

#: Opens the store, says so, and makes an event for each line that it is sent.
OLD_PROCESS = """
import sys
from sceneprint.errors import SceneprintError
from sceneprint.store import open_database
from sceneprint.store.events import record_event

database = open_database(sys.argv[1])
print("open", flush=True)
for line in sys.stdin:
    name, turn = line.split()
    try:
        with database.write(turn=turn == "turn") as connection:
            record_event(connection, "map.edited", name)
        print("written", flush=True)
    except SceneprintError as error:
        print(f"{type(error).__name__}: {error}", flush=True)
"""


@pytest.fixture
def old_process(url, store):
    """A process that has the store open."""
    started = subprocess.Popen(
        [sys.executable, "-c", OLD_PROCESS, url],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    with started:
        assert started.stdout.readline() == "open\n"
        yield started
        started.stdin.close()


#: A migration of a later version, of which the schema of this one is the first.
MIGRATION = """
from alembic import op

revision = "{revision}"
down_revision = "{before}"
branch_labels = None
depends_on = None


def upgrade():
    op.execute("{statement}")
"""


@pytest.fixture
def upgrade(url, tmp_path, monkeypatch):
    """Adds a migration to those that are installed, and opens the store with it."""
    folder = tmp_path / "migrations"
    shutil.copytree(Path(migrations.__file__).parent, folder)

    def open_later(revision, before, statement):
        text = MIGRATION.format(revision=revision, before=before, statement=statement)
        (folder / "versions" / f"{revision}.py").write_text(text)
        known_revisions.cache_clear()
        open_database(url).close()

    monkeypatch.setattr(database, "_FOLDER", folder)
    yield open_later
    monkeypatch.undo()
    known_revisions.cache_clear()


def _set_schema(url, revision, least):
    """Let a store say that a migration of a later version ran."""
    with closing(reach_database(url)) as later, later.write() as connection:
        connection.execute(text("UPDATE alembic_version SET version_num = :v"), {"v": revision})
        connection.execute(text("UPDATE schema_range SET least_revision = :v"), {"v": least})


def _names(url):
    with closing(reach_database(url)) as found, found.read() as connection:
        return list(connection.execute(text("SELECT map FROM events ORDER BY number")).scalars())


def test_an_old_process_writes_as_long_as_the_schema_allows_it(url, old_process, upgrade):
    def write(name, turn="turn"):
        assert old_process.stdin is not None
        print(name, turn, file=old_process.stdin, flush=True)
        return old_process.stdout.readline()

    own = known_revisions()[0]
    assert write("first") == "written\n"
    upgrade("0098", own, "ALTER TABLE tenants ADD COLUMN colour TEXT")
    assert _range(url) == ("0098", own)
    assert write("second") == "written\n"
    upgrade("0099", "0098", "UPDATE schema_range SET least_revision = '0098'")
    assert _range(url) == ("0099", "0098")
    for turn in ("turn", "none"):
        answer = write("third", turn)
        assert answer.startswith("NewerSchema: ")
        assert (
            "was migrated to schema 0099 of a later version of sceneprint while this process, "
            f"which needs {own}, was running. Nothing was stored. Stop this process, and start the "
            "version of the other processes."
        ) in answer
    assert _names(url) == ["first", "second"]


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
