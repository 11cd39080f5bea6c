"""Write groups: writes that arrive during another write share the next transaction.

A commit waits for the disk regardless of its size, so eight clients need not wait eight times.

    run(a), run(b), run(c)  --Grouping, in one commit-->       each gets its own result
    receive(a), receive(b)  --NewFrames, in one statement-->   whether each was inserted
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

#: Maximum number of writes in one transaction, for which other writers wait.
MOST_TOGETHER = 32
#: Seconds for which new frames of several maps wait for a locked map. Locks usually last a few
#: milliseconds.
MAPS_WAIT_S = 0.25


class _Waiting(Generic[W]):
    """A waiting write, and its result.

    Parameters
    ----------
    leads : whether its thread writes for all threads; see `_Group`
    ready : set when the write is done, or its thread leads
    left : whether its thread no longer waits
    """

    def __init__(self, work: W) -> None:
        self.work = work
        self.leads, self.ready = False, threading.Event()
        self.done = self.left = False
        self.result: Any = None
        self.error: Exception | None = None


class _Group(Generic[W]):
    """Writes of many threads, of which one at a time leads and performs all waiting writes."""

    def __init__(self) -> None:
        self._waiting: list[_Waiting[W]] = []
        self._list = threading.Lock()
        self._led = False

    def _await(self, work: W) -> Any:
        """Add a write, wait until this or another thread has performed it, and return its result.

        The error of the write is raised. An interrupted thread withdraws a write that waits.
        """
        mine = _Waiting(work)
        with self._list:
            self._waiting.append(mine)
            mine.leads, self._led = not self._led, True
        try:
            if not mine.leads:
                mine.ready.wait()
            while not mine.done:  # a batch may end before this write
                self._write()
        except BaseException:  # such as Ctrl-C
            with self._list:
                mine.left = True  # the leading thread must not return this write to the list
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
        """Pass the lead to the next thread."""
        with self._list:
            self._led = bool(self._waiting)
            if self._waiting:
                self._waiting[0].leads = True
                self._waiting[0].ready.set()

    def _write(self) -> None:
        """Perform a batch of the first waiting writes."""
        batch: list[_Waiting[W]] = []
        try:
            self._write_together(batch)
        except BaseException:  # Ctrl-C stops only this caller, so others perform their writes
            with self._list:
                back = [one for one in batch if not (one.done or one.left)]
                self._waiting = back + self._waiting
            raise
        finally:
            for one in batch:
                if one.done:
                    one.ready.set()

    def _take(self, batch: list[_Waiting[W]], *, all_: bool = False) -> None:
        """Move the first waiting writes to `batch`."""
        with self._list:
            batch[:] = self._waiting[: None if all_ else MOST_TOGETHER]
            del self._waiting[: len(batch)]

    def _write_together(self, batch: list[_Waiting[W]]) -> None:
        """Perform waiting writes in one transaction, and return them in `batch`."""
        raise NotImplementedError


_Work = Callable[[Connection], Any]


class Grouping(_Group[_Work]):
    """Group of threads that share transactions on one database.

    Parameters
    ----------
    database, map_number : see `Database.write`
    """

    def __init__(self, database: Database, map_number: int | None = None) -> None:
        super().__init__()
        self._database, self._map_number = database, map_number

    def run(self, do: Callable[[Connection], T]) -> T:
        """Call a function in a write transaction, and return its result after the commit.

        Parameters
        ----------
        do : function that writes. It may be called several times, and must raise errors other than
            `UnusableStore` before it writes, since other writes of the transaction continue
        """
        own = copy_context()  # another thread may call the function
        return cast(T, self._await(lambda connection: own.run(do, connection)))

    def _write_together(self, batch: list[_Waiting[_Work]]) -> None:
        """Perform waiting writes in one transaction, or each in its own after an error."""
        try:
            with self._database.write(map_number=self._map_number) as connection:
                self._take(batch)  # after the wait for the lock, since more writes have arrived
                for one in batch:
                    _do(one, connection)
        except Exception as error:
            if not batch:  # the lock was not acquired, so all waiting writes fail
                self._take(batch, all_=True)
            of_all = isinstance(error, UnusableStore) and not is_conflict(error)
            if len(batch) == 1 or of_all:
                for one in batch:
                    one.result, one.error = None, error
            else:
                for one in batch:  # one write made the shared transaction fail
                    self._write_alone(one)
                    one.done = True
        for one in batch:
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
    """Group of threads that insert new frames of many maps by one statement on PostgreSQL."""

    def __init__(self, database: Database) -> None:
        super().__init__()
        self._database = database

    def receive(self, frame: NewFrame) -> bool:
        """Insert a frame, and return after the commit.

        Returns
        -------
        inserted : whether the frame was inserted. If not, it must be written alone, because it is
            not new (see `receive_frames`), another frame failed, or a map was locked

        Raises
        ------
        UnusableStore : See `Database.write`.
        """
        return cast(bool, self._await(frame))

    def _write_together(self, batch: list[_Waiting[NewFrame]]) -> None:
        self._take(batch)
        frames = [one.work for one in batch]
        numbers = {one.row.number for one in frames}
        try:
            with self._database.write_maps(numbers, MAPS_WAIT_S) as connection:
                ids = receive_frames(connection, frames)
            for one in batch:
                one.result = one.work.frame_id in ids
        except UnusableStore as error:
            for one in batch:
                one.error = error
        except Exception:  # separate writes show which frame is wrong
            for one in batch:
                one.result = False
        for one in batch:
            one.done = True
