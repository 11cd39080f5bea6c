"""Write groups: writers that come while another one writes are written together in the next
transaction. A commit waits for the disk, whatever is in it, and eight clients need not wait eight
times.

    run(a), run(b), run(c)  --Grouping.run, in one commit-->  each gets its own result
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextvars import copy_context
from typing import Any, TypeVar, cast

from sqlalchemy import Connection

from sceneprint.errors import SceneprintError, UnusableStore
from sceneprint.store import Database

T = TypeVar("T")

#: Pieces of work in one transaction: other writers wait meanwhile.
MOST_TOGETHER = 32


class _Waiting:
    """A piece of work, and what came of it."""

    def __init__(self, do: Callable[[Connection], Any]) -> None:
        own = copy_context()  # another thread may do it: what it says of a request is of this one
        self.do: Callable[[Connection], Any] = lambda connection: own.run(do, connection)
        self.done = False
        self.result: Any = None
        self.error: Exception | None = None


class Grouping:
    """Writes of many threads to one database; safe to share between them.

    Parameters
    ----------
    database, map_number : see `Database.write`
    """

    def __init__(self, database: Database, map_number: int | None = None) -> None:
        self._database, self._map_number = database, map_number
        self._waiting: list[_Waiting] = []
        self._list = threading.Lock()
        self._writing = threading.Lock()

    def run(self, do: Callable[[Connection], T]) -> T:
        """Do it in a writing transaction; when this returns it is committed.

        Parameters
        ----------
        do : whatever it raises of `SceneprintError`, beside `UnusableStore`, it raises before it
            writes: others of the transaction go on. It may be called more than once

        Raises
        ------
        what `do` raises, and what `Database.write` does.
        """
        mine = _Waiting(do)
        with self._list:
            self._waiting.append(mine)
        try:
            with self._writing:  # meanwhile somebody may have written mine with his own
                while not mine.done:  # there may be more before it than are written at once
                    self._write()
        except BaseException:  # such as Ctrl-C
            with self._list:
                if mine in self._waiting:
                    self._waiting.remove(mine)
            raise
        if mine.error is not None:
            raise mine.error
        return cast(T, mine.result)

    def run_single(self, do: Callable[[Connection], T | None]) -> T | None:
        """Do what is one statement as a transaction of its own; see `SingleStatement`.

        Returns
        -------
        result : None, and nothing was written, where `do` says so, while others write, whom more
            may join, and on SQLite, whose transactions cost no round trip
        """
        if self._map_number is None or not self._writing.acquire(blocking=False):
            return None
        try:
            with self._database.write(map_number=self._map_number, single=True) as connection:
                return do(connection)
        finally:
            self._writing.release()

    def _write(self) -> None:
        """Write what waits, from the first on."""
        taken: list[_Waiting] = []
        try:
            self._write_together(taken)
        except BaseException:  # Ctrl-C is the caller's alone: the others write themselves
            with self._list:
                self._waiting = [one for one in taken if not one.done] + self._waiting
            raise

    def _write_together(self, taken: list[_Waiting]) -> None:
        """Write what waits in one transaction, or each alone; `taken` is filled with it."""
        try:
            with self._database.write(map_number=self._map_number) as connection:
                with self._list:  # not before it is our turn: more have come since
                    taken[:], self._waiting = (
                        self._waiting[:MOST_TOGETHER],
                        self._waiting[MOST_TOGETHER:],
                    )
                for one in taken:
                    _do(one, connection)
        except Exception as error:
            if not taken:  # it was never our turn: who waits has waited as long
                with self._list:
                    taken[:], self._waiting = self._waiting, []
            if len(taken) == 1 or isinstance(error, UnusableStore):
                for one in taken:
                    one.result, one.error = None, error
            else:
                for one in taken:  # one of them broke the transaction of all
                    self._write_alone(one)
                    one.done = True
        for one in taken:
            one.done = True

    def _write_alone(self, one: _Waiting) -> None:
        one.result = one.error = None
        try:
            with self._database.write(map_number=self._map_number) as connection:
                _do(one, connection)
        except Exception as error:
            one.result, one.error = None, error


def _do(one: _Waiting, connection: Connection) -> None:
    one.result = one.error = None
    try:
        one.result = one.do(connection)
    except UnusableStore:
        raise
    except SceneprintError as error:
        one.error = error
