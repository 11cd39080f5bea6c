"""Tests of read-only databases, which are read correctly or not at all."""

import os
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import pytest
from sqlalchemy import create_engine, text
from sqlalchemy.exc import OperationalError

from sceneprint.errors import ReadOnlyStore, UnusableStore
from sceneprint.store import open_database, open_store
from sceneprint.store.database import Database
from sceneprint.store.sqlite import ReadOnlyFile

#: A reader without the right to write, that does what it reads on standard input; permissions
#: hold for root as well: PR_CAPBSET_DROP, CAP_DAC_OVERRIDE.
READER = """
import ctypes, os, sys
if len(sys.argv) == 2:
    assert os.getuid() or ctypes.CDLL(None).prctl(24, 1, 0, 0, 0) == 0
    os.execv(sys.executable, [sys.executable, "-c", os.environ["READER"], *sys.argv[1:], "held"])
from pathlib import Path
from sqlalchemy import text
from sceneprint.errors import SceneprintError
from sceneprint.store import open_store
folder = Path(sys.argv[1])
store = None
for line in sys.stdin:
    try:
        if store is None:
            store = open_store(f"sqlite:///{folder}/a.db", folder / "blobs")
            assert store.database.read_only
        if line == "write\\n":
            with store.database.write():
                print("written")
        with store.database.read() as connection:
            found = connection.execute(text("SELECT sum(number) FROM events")).scalar()
        print(found, sorted(os.listdir(folder)), flush=True)
    except SceneprintError as error:
        print(f"{type(error).__name__}: {error}", flush=True)
"""


@pytest.fixture
def folder(tmp_path):
    """A database with one row, closed, and read-only for who has no special rights."""
    folder = tmp_path / "data"
    folder.mkdir()
    open_database(f"sqlite:///{folder}/a.db").close()
    add(folder)
    folder.chmod(0o555)
    yield folder
    folder.chmod(0o755)


def insert(connection):
    connection.execute("INSERT INTO events (at, kind, data) VALUES (0, 'x', '{}')")
    connection.commit()


def add(folder):
    with closing(sqlite3.connect(folder / "a.db")) as connection:
        insert(connection)


@pytest.fixture
def ask(folder):
    """A function that asks a process that may only read, and returns its answer."""
    with subprocess.Popen(
        [sys.executable, "-c", READER, str(folder)], text=True,
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=os.environ | {"READER": READER},
    ) as process:  # fmt: skip

        def ask(what="read"):
            print(what, file=process.stdin, flush=True)
            return process.stdout.readline().strip()

        yield ask
        process.stdin.close()


@pytest.mark.skipif(os.getuid() != 0, reason="another user must write what this one may only read")
def test_who_may_only_read_sees_what_others_write(folder, ask):
    assert ask() == "1 ['a.db']"
    assert ask("write").startswith("ReadOnlyStore: ")
    writer = sqlite3.connect(folder / "a.db")
    insert(writer)  # into the log
    assert ask() == "3 ['a.db', 'a.db-shm', 'a.db-wal']"
    insert(writer)
    assert ask() == "6 ['a.db', 'a.db-shm', 'a.db-wal']"
    writer.close()
    assert ask() == "6 ['a.db']"


@pytest.mark.skipif(os.getuid() != 0, reason="another user must write what this one may only read")
def test_a_log_that_was_left_is_read_or_refused(folder, ask):
    """As after the power was lost, with and without the index of the log."""
    with closing(sqlite3.connect(folder / "a.db")) as writer:
        insert(writer)
        left = {end: (folder / f"a.db{end}").read_bytes() for end in ("", "-wal", "-shm")}
    for end, data in left.items():
        (folder / f"a.db{end}").write_bytes(data)
    assert ask() == "3 ['a.db', 'a.db-shm', 'a.db-wal']"
    (folder / "a.db-shm").unlink()
    answer = ask()  # the row in the log must not be overlooked
    assert answer.startswith("UnusableStore: ")
    assert "was not closed properly, and cannot be recovered on a read-only disk" in answer
    (folder / "a.db-wal").write_bytes(b"")
    assert ask() == "1 ['a.db', 'a.db-wal']"  # all that the file itself holds


def test_a_file_that_changes_while_it_is_read_is_not_believed(folder):
    """It is read without locks, as unchanging; somebody writes it after all."""
    folder.chmod(0o755)
    sealed = ReadOnlyFile(folder / "a.db")
    engine = create_engine(f"sqlite:///{folder}/a.db", creator=sealed.connect)
    database = Database(engine, sealed)

    def total(meanwhile):
        with database.read() as connection:
            meanwhile()
            return int(connection.execute(text("SELECT sum(number) FROM events")).scalar_one())

    assert total(lambda: None) == 1
    with pytest.raises(UnusableStore, match=r"Another process wrote to.*Try again"):
        total(lambda: add(folder))
    database.close()  # who asks again, has it opened again
    assert total(lambda: None) == 3
    database.close()


def test_a_disk_that_turns_read_only_is_said(tmp_path, monkeypatch):
    store = open_store(f"sqlite:///{tmp_path}/truth.db", tmp_path / "blobs")
    assert not store.read_only
    with monkeypatch.context() as disk:  # blobs are on a disk of their own
        disk.setattr(os, "access", lambda path, _: Path(path) != tmp_path / "blobs")
        assert (store.read_only, store.database.turned_read_only) == (True, False)
    assert not store.read_only
    with monkeypatch.context() as disk:
        disk.setattr(os, "access", lambda *_: False)
        assert store.database.turned_read_only
        read_only = SimpleNamespace(f_flag=os.ST_RDONLY, f_bavail=1 << 30, f_frsize=4096)
        disk.setattr(os, "statvfs", lambda _: read_only)
        fault = sqlite3.OperationalError("disk I/O error")  # of a write to a file that is open
        fault.sqlite_errorcode = sqlite3.SQLITE_IOERR_WRITE
        said = "disk I/O error. The disk is mounted read-only"
        with pytest.raises(ReadOnlyStore, match=said), store.database.translate_errors():
            raise OperationalError("COMMIT", {}, fault)
    store.close()
