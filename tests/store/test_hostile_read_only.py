"""Tests of read-only databases, which are read correctly or not at all."""

import os
import sqlite3
import subprocess
import sys
from contextlib import closing

import pytest
from sqlalchemy import create_engine, text

from sceneprint.errors import UnusableStore
from sceneprint.store import open_database
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


class Reader:
    """The process that may only read."""

    def __init__(self, folder):
        self.process = subprocess.Popen(
            [sys.executable, "-c", READER, str(folder)], text=True,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=os.environ | {"READER": READER},
        )  # fmt: skip

    def ask(self, what="read"):
        self.process.stdin.write(f"{what}\n")
        self.process.stdin.flush()
        return self.process.stdout.readline().strip()


@pytest.fixture
def reader(folder):
    """Started when a test asks it first; what it says is that of one process."""
    made = Reader(folder)
    yield made
    with made.process:
        made.process.stdin.close()


@pytest.mark.skipif(os.getuid() != 0, reason="another user must write what this one may only read")
def test_who_may_only_read_sees_what_others_write(folder, reader):
    assert reader.ask() == "1 ['a.db']"
    assert reader.ask("write").startswith("ReadOnlyStore: ")
    writer = sqlite3.connect(folder / "a.db")
    insert(writer)  # into the log
    assert reader.ask() == "3 ['a.db', 'a.db-shm', 'a.db-wal']"
    insert(writer)
    assert reader.ask() == "6 ['a.db', 'a.db-shm', 'a.db-wal']"
    writer.close()
    assert reader.ask() == "6 ['a.db']"


@pytest.mark.skipif(os.getuid() != 0, reason="another user must write what this one may only read")
def test_a_log_that_was_left_is_read_or_refused(folder, reader):
    """As after the power was lost, with and without the index of the log."""
    with closing(sqlite3.connect(folder / "a.db")) as writer:
        insert(writer)
        left = {end: (folder / f"a.db{end}").read_bytes() for end in ("", "-wal", "-shm")}
    for end, data in left.items():
        (folder / f"a.db{end}").write_bytes(data)
    assert reader.ask() == "3 ['a.db', 'a.db-shm', 'a.db-wal']"
    (folder / "a.db-shm").unlink()
    told = reader.ask()  # the row in the log must not be overlooked
    assert told.startswith("UnusableStore: ")
    assert "was not closed properly, and cannot be recovered on a read-only disk" in told
    (folder / "a.db-wal").write_bytes(b"")
    assert reader.ask() == "1 ['a.db', 'a.db-wal']"  # all that the file itself holds


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


def test_a_later_schema_on_a_read_only_folder_is_left_alone(folder, reader):
    folder.chmod(0o755)
    with closing(sqlite3.connect(folder / "a.db")) as connection:
        connection.execute("UPDATE alembic_version SET version_num = '9999'")
        connection.execute("UPDATE schema_range SET least_revision = '9999'")
        connection.commit()
    folder.chmod(0o555)
    before = (folder / "a.db").read_bytes()
    said = f"NewerSchema: sqlite:///{folder}/a.db has schema 9999 of a later version"
    assert reader.ask().startswith(said)
    assert (folder / "a.db").read_bytes() == before
    assert [path.name for path in folder.iterdir()] == ["a.db"]


#: Run as root of a mount namespace of its own; blobs are a mount that nobody holds open.
REMOUNTED = """
import sqlite3, subprocess, sys
from pathlib import Path
from sqlalchemy.exc import OperationalError
from sceneprint.errors import ReadOnlyStore
from sceneprint.store import open_store
from sceneprint.store.database import reach_database

def mount(*how):
    subprocess.run(["mount", *how], check=True)

folder = Path(sys.argv[1])
store = open_store(f"sqlite:///{folder}/truth.db", folder / "blobs")
mount("--bind", str(folder / "blobs"), str(folder / "blobs"))
print(store.read_only)
store.blobs.put(b"before")
mount("-o", "remount,bind,ro", str(folder / "blobs"))
print(store.read_only, store.database.turned_read_only)
try:
    store.blobs.put(b"after")
except ReadOnlyStore as error:
    print(error)
mount("-o", "remount,bind,rw", str(folder / "blobs"))
print(store.read_only)
store.close()
mount("--bind", str(folder), str(folder))
mount("-o", "remount,bind,ro", str(folder))
print(store.read_only)
fault = sqlite3.OperationalError("disk I/O error")  # of a write to a file that is open
fault.sqlite_errorcode = sqlite3.SQLITE_IOERR_WRITE
database = reach_database(f"sqlite:///{folder}/truth.db")
try:
    with database.explained():
        raise OperationalError("COMMIT", {}, fault)
except ReadOnlyStore as error:
    print(error)
"""


def test_a_disk_that_turns_read_only_is_said(tmp_path):
    if subprocess.run(["unshare", "-rm", "true"], capture_output=True).returncode != 0:
        pytest.skip("no namespace of mounts can be made here")
    done = subprocess.run(
        ["unshare", "-rm", sys.executable, "-c", REMOUNTED, str(tmp_path)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    before, blobs, put, again, all_of_it, fault = done.stdout.splitlines()
    assert (before, blobs, again, all_of_it) == ("False", "True False", "False", "True")
    assert put.endswith(
        "(Read-only file system). It is read-only. Make it writable, or use another folder."
    )
    assert "disk I/O error. The disk is mounted read-only" in fault
