"""A process of an earlier version, and a store that a later one has migrated under it."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from secrets import token_hex

import pytest
from sqlalchemy import text

from benchmarks.fleet.postgres import Server
from sceneprint.cli import main
from sceneprint.errors import NewerSchema
from sceneprint.store import Store, open_database
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
def old_process(url: str, store: Store) -> Iterator[subprocess.Popen[str]]:
    """A process that has the store open."""
    started = subprocess.Popen(
        [sys.executable, "-c", OLD_PROCESS, url],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    with started:
        assert started.stdout is not None
        assert started.stdout.readline() == "open\n"
        yield started
        assert started.stdin is not None
        started.stdin.close()


def _migrate(url: str, revision: str, least: str) -> None:
    """What a migration of a later version leaves."""
    with closing(reach_database(url)) as later, later.write() as connection:
        connection.execute(text("UPDATE alembic_version SET version_num = :v"), {"v": revision})
        connection.execute(text("UPDATE schema_range SET least_revision = :v"), {"v": least})


def _names(url: str) -> list[str]:
    with closing(reach_database(url)) as found, found.read() as connection:
        return list(connection.execute(text("SELECT map FROM events ORDER BY number")).scalars())


def test_an_old_process_writes_as_long_as_the_schema_allows_it(
    url: str, old_process: subprocess.Popen[str]
) -> None:
    assert old_process.stdin is not None
    assert old_process.stdout is not None

    def written(name: str, turn: str = "turn") -> str:
        assert old_process.stdin is not None
        assert old_process.stdout is not None
        print(name, turn, file=old_process.stdin, flush=True)
        return old_process.stdout.readline()

    head = known_revisions()[0]
    assert written("first") == "written\n"
    _migrate(url, "9998", head)  # it only added
    assert written("second") == "written\n"
    _migrate(url, "9999", "9998")  # it changed or removed
    for turn in ("turn", "none"):
        told = written("third", turn)
        assert told.startswith("NewerSchema: ")
        assert f"was brought to schema 9999 of a later version of sceneprint while this process " \
            f"ran, and this process works with {head}. Nothing was stored. Stop this process, " \
            "and start the version that the others run." in told  # fmt: skip
    assert _names(url) == ["first", "second"]
    with pytest.raises(NewerSchema, match="schema 9999, which this version of sceneprint does"):
        open_database(url)


def test_a_process_may_begin_on_a_later_schema_that_allows_it(url: str, store: Store) -> None:
    _migrate(url, "9999", known_revisions()[0])
    with closing(open_database(url)) as opened, opened.read() as connection:
        found = connection.execute(text("SELECT version_num FROM alembic_version")).scalar_one()
    assert found == "9999"  # as it was


@pytest.mark.parametrize(
    ("revision", "least", "own", "allowed"),
    [
        ("0015", "0015", "0015", True),
        ("0017", "0015", "0015", True),
        ("0017", "0016", "0015", False),
        ("0014", "0013", "0015", False),  # restored under it: migrated when it is opened again
        ("0014", None, "0015", False),
        ("0016", None, "0015", False),
        ("from the future", "0015", "0015", False),
    ],
)
def test_which_processes_a_schema_allows(
    revision: str, least: str | None, own: str, allowed: bool
) -> None:
    assert SchemaRange(revision, least).allows(own) is allowed


def _range(url: str) -> tuple[str, str]:
    """Revision of a store, and the oldest whose processes may write to it."""
    asked = text("SELECT version_num, least_revision FROM alembic_version, schema_range")
    with closing(reach_database(url)) as found, found.read() as connection:
        revision, least = connection.execute(asked).one()
        return revision, least


def test_a_new_store_is_of_this_version_alone(url: str, store: Store) -> None:
    head = known_revisions()[0]
    assert store.database.dialect in url
    assert _range(url) == (head, head)


@pytest.mark.parametrize("least", ["0015", "0020"])
def test_a_migrated_store_allows_what_it_allowed(url: str, store: Store, least: str) -> None:
    assert store.database.dialect in url
    _migrate(url, "0020", least)  # whose tables are the same
    open_database(url).close()
    assert _range(url) == (known_revisions()[0], least)
    assert SchemaRange(*_range(url)).allows("0020")


@pytest.fixture
def migrate_command(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., tuple[int, str, str]]:
    """Exit code, output and error of `sceneprint migrate`.

    In this process: six that start take 6 s of processor time.
    """

    def run(url: str, folder: Path, *options: str) -> tuple[int, str, str]:
        monkeypatch.setenv("SCENEPRINT_DATABASE_URL", url)
        code = main(["migrate", "--data", f"{folder}", *options])
        said = capsys.readouterr()
        return code, said.out.strip(), said.err.strip()

    return run


@pytest.mark.parametrize("kind", ["sqlite", "postgresql"])
def test_the_command_makes_the_schema_once(
    kind: str,
    migrate_command: Callable[..., tuple[int, str, str]],
    tmp_path: Path,
    request: pytest.FixtureRequest,
) -> None:
    if kind == "sqlite":
        url = f"sqlite:///{tmp_path}/data/sceneprint.db"
    else:
        server: Server = request.getfixturevalue("postgres")
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
    _migrate(url, "9999", head)  # later, and this version may still write to it
    code, said, _ = migrate_command(url, data, "--check")
    assert (code, said.endswith("schema 9999")) == (0, True)
    _migrate(url, "9999", "9998")
    code, _, error = migrate_command(url, data)
    assert (code, "a later one wrote it" in error) == (2, True)


def test_the_command_completes_an_upgrade_once(
    url: str, store: Store, tmp_path: Path,
    migrate_command: Callable[..., tuple[int, str, str]],
) -> None:  # fmt: skip
    head, place = known_revisions()[0], store.database.shown

    def complete() -> tuple[int, str, str]:
        return migrate_command(url, tmp_path, "--complete")

    completed = f"{place}: upgrade to schema {head} completed; earlier versions may not write"
    before = completed.replace("completed", "was completed before")
    assert complete() == (0, before, "")  # it is new
    _migrate(url, head, "0015")
    code, _, error = migrate_command(url, tmp_path)
    assert (code, error, _range(url)) == (0, "", (head, "0015"))
    assert complete() == (0, completed, "")
    assert _range(url) == (head, head)
    assert not SchemaRange(*_range(url)).allows("0020")
    assert complete() == (0, before, "")
    for other, what in (
        ("0020", "Run `sceneprint migrate` first"),
        ("9999", "a later one migrated it. Complete the upgrade with that version."),
    ):
        _migrate(url, other, "0015")
        code, said, error = complete()
        assert (code, said, len(error.splitlines())) == (2, "", 1)
        assert f"has schema {other}, and this version of sceneprint works with {head}" in error
        assert what in error
        assert ("Run `sceneprint migrate`" in error) == (other == "0020")
        assert _range(url) == (other, "0015")


@pytest.mark.parametrize("kind", ["sqlite", "postgresql"])
def test_there_is_no_upgrade_to_complete_without_a_schema(
    kind: str, tmp_path: Path, request: pytest.FixtureRequest,
    migrate_command: Callable[..., tuple[int, str, str]],
) -> None:  # fmt: skip
    url = f"sqlite:///{tmp_path}/data/sceneprint.db"
    if kind == "postgresql":
        server: Server = request.getfixturevalue("postgres")
        url = server.create(f"empty_{token_hex(4)}")
    code, said, error = migrate_command(url, tmp_path / "data", "--complete")
    assert (code, said, len(error.splitlines())) == (2, "", 1)
    assert "has no schema, so there is no upgrade to complete" in error
    assert not (tmp_path / "data").exists()
