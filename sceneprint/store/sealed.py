"""A SQLite file that may be read and not written: on a read-only disk, or of another user.

SQLite reads a database with a log (`-wal`) only together with the log's index (`-shm`), which it
cannot make here. Without a log the file is all there is, and is read as it lies, without locks.
That would be wrong where somebody can write it after all, as through another mount: whether the
file stayed as it was is looked at after every transaction.
"""

from __future__ import annotations

import os
import sqlite3
from pathlib import Path

from sqlalchemy import URL, make_url
from sqlalchemy.exc import ArgumentError

from sceneprint.errors import ReadOnlyStore, UnusableStore


def sealed_file(url: URL) -> Path | None:
    """The file of a SQLite database, if it is there and it, or what is beside it, is read-only."""
    name = url.database or ""
    if url.get_backend_name() != "sqlite" or name in ("", ":memory:") or name.startswith("file:"):
        return None
    path = Path(name).absolute()
    writable = os.access(path, os.W_OK) and os.access(path.parent, os.W_OK)
    return path if path.exists() and not writable else None


def is_sealed(url: str) -> bool:
    """Whether a database may be read alone; False for what is none."""
    try:
        return sealed_file(make_url(url)) is not None
    except (ArgumentError, ValueError):
        return False


class Sealed:
    """Reads such a file.

    Parameters
    ----------
    path : of the database
    """

    def __init__(self, path: Path) -> None:
        self._path = path

    def connect(self) -> sqlite3.Connection:
        """Open it in the way that is right at this moment.

        Raises
        ------
        UnusableStore : it was not closed, and cannot be recovered without writing.
        """
        has_log, has_index = self._log(), self._beside("-shm").exists()
        if (has_log and not has_index) or self._beside("-journal").exists():
            raise UnusableStore(
                f"{self._path} was not closed, and on a read-only disk it cannot be recovered. "
                "Open the data folder once where it may be written, or use a copy."
            )
        how = "mode=ro" if has_log else "mode=ro&immutable=1"
        return sqlite3.connect(f"{self._path.as_uri()}?{how}", uri=True, check_same_thread=False)

    def state(self) -> tuple[object, ...]:
        """What must be the same before and after a transaction."""
        if self._log():
            return ()  # SQLite's own locks tell one transaction from another
        try:
            found = self._path.stat()
        except OSError:
            return ("gone",)
        return found.st_mtime_ns, found.st_size, found.st_ino

    def check(self, before: object) -> None:
        """See at the end of a transaction that nobody has written meanwhile.

        Raises
        ------
        UnusableStore : somebody has.
        """
        if self.state() != before:
            raise UnusableStore(
                f"{self._path} was written by somebody else while it was read as unchanging. "
                "Ask again."
            )

    def refusal(self) -> ReadOnlyStore:
        """What a writer is told."""
        return ReadOnlyStore(
            f"{self._path} or its folder is read-only: it is read, and nothing can be stored. "
            "Make both writable for this user, and start again."
        )

    def _log(self) -> bool:
        """Whether there is a log with something in it, or one that somebody has just begun."""
        try:
            size = self._beside("-wal").stat().st_size
        except OSError:
            return False
        return size > 0 or self._beside("-shm").exists()

    def _beside(self, end: str) -> Path:
        return self._path.with_name(self._path.name + end)
