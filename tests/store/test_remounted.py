"""A disk that turns read-only under a store that is open."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

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


def test_a_disk_that_turns_read_only_is_said(tmp_path: Path) -> None:
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
        "(Read-only file system). It is read-only: make it writable, or name another folder."
    )
    assert "disk I/O error. Its disk is mounted read-only" in fault
