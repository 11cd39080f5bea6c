"""Inject a fault at the n-th call of this process that changes a folder or its database.

Calls of Python that open a file for writing, rename, link or remove are seen by an audit hook.
`os.write`, `os.fsync` and the statements and commits of the database are wrapped. A hook cannot be
removed: inject in a process that ends afterwards.
"""

import errno
import os
import signal
import sqlite3
import sys
from pathlib import Path

from sqlalchemy.engine.default import DefaultDialect

from tests.faults.disk import CutDisk

#: Faults by name: the error of a call on files, and SQLite's message; None for the others.
#: `power cut` kills the process, and undoes what was not synced. `interrupts` sends signals from
#: the call on, which interrupt system calls (EINTR).
FAULTS = {
    "full disk": (errno.ENOSPC, "database or disk is full"),
    "input/output error": (errno.EIO, "disk I/O error"),
    "no descriptors": (errno.EMFILE, "unable to open database file"),
    "interrupts": None,
    "kill": None,
    "power cut": None,
}
#: Interval of the signals, seconds.
_EVERY_S = 2e-4
#: Audit events of calls that change a folder, and how many of their first arguments are paths.
_EVENTS = {
    "open": 1, "os.rename": 2, "os.link": 2, "os.remove": 1, "os.mkdir": 1, "os.rmdir": 1,
    "os.truncate": 1,
}  # fmt: skip
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT
#: First words of statements that change the database or hold a turn to do so.
_STATEMENTS = ("BEGIN IMMEDIATE", "INSERT", "UPDATE", "DELETE", "CREATE", "COMMIT")


class Injector:
    """Counts the calls on a folder and its database, and lets the one with number `at` fail."""

    def __init__(self, root, fault, at):
        self._root, self._error, self._at = str(root), FAULTS[fault], at
        self._fault, self._only_opens = fault, fault == "no descriptors"
        self._disk = CutDisk(root) if fault == "power cut" else None
        self.calls, self.failed, self._is_armed = 0, "", False

    def arm(self):
        signal.signal(signal.SIGALRM, lambda *_: None)
        sys.addaudithook(self._audit)
        for name in ("write", "pwrite", "fsync", "fdatasync"):
            setattr(os, name, self._on_descriptor(name, getattr(os, name)))
        dialect = DefaultDialect
        for name in ("do_execute", "do_executemany", "do_commit"):
            setattr(dialect, name, self._on_database(name, getattr(dialect, name)))
        self._is_armed = True

    def disarm(self):
        """Stop counting. A power cut after the last call ends the process."""
        self._is_armed = False
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        if self._disk is not None and not self.failed:
            self._disk.cut()

    def _audit(self, event, arguments):
        if not self._is_armed or event not in _EVENTS:
            return
        if event == "open" and not (arguments[2] or 0) & _WRITING:
            return
        if any(self._is_inside(path) for path in arguments[: _EVENTS[event]]):
            if self._disk is not None:
                self._disk.look()
            self._count(event, is_open=event == "open")

    def _is_inside(self, path):
        if isinstance(path, int):
            return self._holds(path)
        return isinstance(path, str | os.PathLike) and os.fspath(path).startswith(self._root)

    def _holds(self, descriptor):
        try:
            return str(Path(f"/proc/self/fd/{descriptor}").readlink()).startswith(self._root)
        except OSError:
            return False

    def _on_descriptor(self, name, call):
        def wrapped(descriptor, *more):
            if self._is_armed and self._holds(descriptor):
                self._count(f"os.{name}")
            result = call(descriptor, *more)
            if self._is_armed and self._disk is not None and "sync" in name:
                self._disk.synced(descriptor)
            return result

        return wrapped

    def _on_database(self, name, call):
        def wrapped(dialect, cursor, statement="COMMIT", *more):
            if self._is_armed and statement.lstrip().startswith(_STATEMENTS):
                self._count(" ".join(statement.split()[:3]), cursor=cursor)
            if name == "do_commit":
                return call(dialect, cursor)
            return call(dialect, cursor, statement, *more)

        return wrapped

    def _count(self, call, *, is_open=False, cursor=None):
        if self._only_opens and not is_open:
            return
        self.calls += 1
        if self.calls != self._at:
            return
        self.failed = call
        if self._disk is not None:
            self._disk.cut()
        if self._fault == "interrupts":
            signal.setitimer(signal.ITIMER_REAL, _EVERY_S, _EVERY_S)
        if self._error is None:
            if self._fault == "kill":
                os.kill(os.getpid(), signal.SIGKILL)
            return
        number, message = self._error
        if cursor is None:
            raise OSError(number, os.strerror(number))
        connection = getattr(cursor, "connection", cursor)
        if isinstance(connection, sqlite3.Connection):
            raise sqlite3.OperationalError(message)
        connection.close()  # the call itself fails then, as if the server had gone
