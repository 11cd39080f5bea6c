"""Write groups: writers that come while another one writes are written together in the next
transaction. A commit waits for the disk, whatever is in it, and eight clients need not wait eight
times.

    run(a), run(b), run(c)  --Grouping, in one commit-->       each gets its own result
    receive(a), receive(b)  --NewFrames, in one statement-->   whether each was taken
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextvars import copy_context
from typing import Any, Generic, TypeVar, cast

from sqlalchemy import Connection

from sceneprint.errors import SceneprintError, UnusableStore
from sceneprint.store import Database
from sceneprint.store.database_errors import is_conflict
from sceneprint.store.new_frames import NewFrame, receive_frames

T = TypeVar("T")
W = TypeVar("W")

#: Pieces of work in one transaction: other writers wait meanwhile.
MOST_TOGETHER = 32
#: Seconds that new frames of several maps wait for one of them. It is in use for a few milliseconds
#: as a rule; where it takes longer, the others should not wait for it.
MAPS_WAIT_S = 0.25


class _Waiting(Generic[W]):
    """A piece of work, and what came of it.

    Parameters
    ----------
    leads : whether its thread writes what waits, or is to begin with that; see `_Group`
    told : set when it is done, or leads
    left : whether its thread waits no more
    """

    def __init__(self, work: W) -> None:
        self.work = work
        self.leads, self.told = False, threading.Event()
        self.done = self.left = False
        self.result: Any = None
        self.error: Exception | None = None


class _Group(Generic[W]):
    """Pieces of work of many threads. One thread at a time does what waits together with its own;
    then the next one does what has come meanwhile.
    """

    def __init__(self) -> None:
        self._waiting: list[_Waiting[W]] = []
        self._list = threading.Lock()
        self._led = False

    def _await(self, work: W) -> Any:
        """Wait until it is done, by this thread or another; its result."""
        mine = _Waiting(work)
        with self._list:
            self._waiting.append(mine)
            mine.leads, self._led = not self._led, True
        try:
            if not mine.leads:
                mine.told.wait()
            while not mine.done:  # there may be more before it than are written at once
                self._write()
        except BaseException:  # such as Ctrl-C
            with self._list:
                mine.left = True  # and is not put back by who has taken it
                if mine in self._waiting:
                    self._waiting.remove(mine)
            raise
        finally:
            if mine.leads:
                self._hand_over()
        if mine.error is not None:
            raise mine.error
        return mine.result

    def _hand_over(self) -> None:
        """Let the next one lead."""
        with self._list:
            self._led = bool(self._waiting)
            if self._waiting:
                self._waiting[0].leads = True
                self._waiting[0].told.set()

    def _write(self) -> None:
        """Write what waits, from the first on."""
        taken: list[_Waiting[W]] = []
        try:
            self._write_together(taken)
        except BaseException:  # Ctrl-C is the caller's alone: the others write themselves
            with self._list:
                back = [one for one in taken if not (one.done or one.left)]
                self._waiting = back + self._waiting
            raise
        finally:
            for one in taken:
                if one.done:
                    one.told.set()

    def _take(self, taken: list[_Waiting[W]], *, all_: bool = False) -> None:
        """Have what waits, from the first on."""
        with self._list:
            taken[:] = self._waiting[: None if all_ else MOST_TOGETHER]
            del self._waiting[: len(taken)]

    def _write_together(self, taken: list[_Waiting[W]]) -> None:
        """Write what waits in one transaction; `taken` is filled with it."""
        raise NotImplementedError


_Work = Callable[[Connection], Any]


class Grouping(_Group[_Work]):
    """Writes of many threads to one database; safe to share between them.

    Parameters
    ----------
    database, map_number : see `Database.write`
    """

    def __init__(self, database: Database, map_number: int | None = None) -> None:
        super().__init__()
        self._database, self._map_number = database, map_number

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
        own = copy_context()  # another thread may do it: what it says of a request is of this one
        return cast(T, self._await(lambda connection: own.run(do, connection)))

    def _write_together(self, taken: list[_Waiting[_Work]]) -> None:
        """Write what waits in one transaction, or each alone."""
        try:
            with self._database.write(map_number=self._map_number) as connection:
                self._take(taken)  # not before it is our turn: more have come since
                for one in taken:
                    _do(one, connection)
        except Exception as error:
            if not taken:  # it was never our turn: who waits has waited as long
                self._take(taken, all_=True)
            of_all = isinstance(error, UnusableStore) and not is_conflict(error)
            if len(taken) == 1 or of_all:
                for one in taken:
                    one.result, one.error = None, error
            else:
                for one in taken:  # one of them broke the transaction of all
                    self._write_alone(one)
                    one.done = True
        for one in taken:
            one.done = True

    def _write_alone(self, one: _Waiting[_Work]) -> None:
        one.result = one.error = None
        try:
            with self._database.write(map_number=self._map_number) as connection:
                _do(one, connection)
        except Exception as error:
            one.result, one.error = None, error


def _do(one: _Waiting[_Work], connection: Connection) -> None:
    one.result = one.error = None
    try:
        one.result = one.work(connection)
    except UnusableStore:
        raise
    except SceneprintError as error:
        one.error = error


class NewFrames(_Group[NewFrame]):
    """New frames of many threads, whatever their maps, taken together by one statement of
    PostgreSQL; safe to share between threads.

    Parameters
    ----------
    database : on PostgreSQL
    """

    def __init__(self, database: Database) -> None:
        super().__init__()
        self._database = database

    def receive(self, frame: NewFrame) -> bool:
        """Take a frame; when this returns, that is committed.

        Returns
        -------
        taken : False, and nothing of it was written: see `receive_frames`; or because another
            frame could not be taken with it, or a map was in use. It has to be written alone

        Raises
        ------
        UnusableStore : see `Database.write`.
        """
        return cast(bool, self._await(frame))

    def _write_together(self, taken: list[_Waiting[NewFrame]]) -> None:
        self._take(taken)
        frames = [one.work for one in taken]
        numbers = {one.row.number for one in frames}
        try:
            with self._database.write_maps(numbers, MAPS_WAIT_S) as connection:
                ids = receive_frames(connection, frames)
            for one in taken:
                one.result = one.work.frame_id in ids
        except UnusableStore as error:
            for one in taken:
                one.error = error
        except Exception:  # who writes it alone finds out what is wrong with it, if anything is
            for one in taken:
                one.result = False
        for one in taken:
            one.done = True
