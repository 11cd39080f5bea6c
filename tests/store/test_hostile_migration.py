"""A disk that has no room while the schema of a database is created."""

from __future__ import annotations

import resource
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

from sceneprint.store import open_database

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


def narrow() -> None:
    """For a child about to begin: its files stay small, as on a disk that is full."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096 * PAGES, 4096 * PAGES))


def schema(path: Path) -> set[tuple[str, ...]]:
    with closing(sqlite3.connect(path)) as connection:
        assert connection.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        return set(connection.execute("SELECT name, sql FROM sqlite_master").fetchall())


def test_a_schema_that_finds_no_room_changes_nothing(tmp_path: Path) -> None:
    path = tmp_path / "truth.db"
    url = f"sqlite:///{path}"
    found = schema(path)
    done = subprocess.run(
        [sys.executable, "-c", OPENS, url], capture_output=True, text=True, check=True,
        preexec_fn=narrow,
    )  # fmt: skip
    assert "that the disk has room" in done.stdout
    assert schema(path) == found
    open_database(url).close()  # and with room it goes on
    assert len(schema(path)) > len(found)
