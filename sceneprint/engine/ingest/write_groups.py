"""Group commit: writes that arrive during another write share the next transaction.

The duration of a commit hardly depends on its size, so shared commits increase the throughput.

    run(a), run(b), run(c)  --Grouping, in one commit-->       result of each call
    receive(a), receive(b)  --NewFrames, in one statement-->   whether each frame was inserted
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

#: Maximum number of writes in one transaction; other writers wait for its end.
MOST_TOGETHER = 32
#: Maximum seconds that a statement with new frames of several maps waits for a locked map.
MAPS_WAIT_S = 0.25


class _Waiting(Generic[W]):
    """A write that waits for its transaction, and its result.

    Parameters
    ----------
    leads : whether the thread of this write is the leader; see `_Group`
    ready : event that is set when the write is done, or its thread becomes the leader
    left : whether the thread was interrupted and has stopped waiting
    """

    def __init__(self, work: W) -> None:
        self.work = work
        self.leads, self.ready = False, threading.Event()
        self.done = self.left = False
        self.result: Any = None
        self.error: Exception | None = None


class _Group(Generic[W]):
    """Writes of many threads; one thread, the leader, performs all waiting writes."""

    def __init__(self) -> None:
        self._waiting: list[_Waiting[W]] = []
        self._list = threading.Lock()
        self._led = False

    def _await(self, work: W) -> Any:
        """Queue a write, wait until a leader has performed it, and return its result or raise its
        error.

        An interruption (such as Ctrl-C) withdraws the write if it has not started.
        """
        mine = _Waiting(work)
        with self._list:
            self._waiting.append(mine)
            mine.leads, self._led = not self._led, True
        try:
            if not mine.leads:
                mine.ready.wait()
            while not mine.done:  # a full batch may exclude this write
                self._write()
        except BaseException:
            with self._list:
                mine.left = True  # the leader must not queue this write again
                if mine in self._waiting:
                    self._waiting.remove(mine)
            raise
        finally:
            if mine.leads:  # pass the lead to the next thread
                with self._list:
                    self._led = bool(self._waiting)
                    if self._waiting:
                        self._waiting[0].leads = True
                        self._waiting[0].ready.set()
        if mine.error is not None:
            raise mine.error
        return mine.result

    def _write(self) -> None:
        """Perform a batch of waiting writes, oldest first."""
        batch: list[_Waiting[W]] = []
        try:
            self._write_together(batch)
        except BaseException:  # an interruption of this thread must not lose writes of others
            with self._list:
                back = [write for write in batch if not (write.done or write.left)]
                self._waiting = back + self._waiting
            raise
        finally:
            for write in batch:
                if write.done:
                    write.ready.set()

    def _take(self, batch: list[_Waiting[W]], *, all_: bool = False) -> None:
        """Move up to MOST_TOGETHER waiting writes to `batch`, or all with `all_`."""
        with self._list:
            batch[:] = self._waiting[: None if all_ else MOST_TOGETHER]
            del self._waiting[: len(batch)]

    def _write_together(self, batch: list[_Waiting[W]]) -> None:
        """Move waiting writes to `batch`, and perform them in one transaction."""
        raise NotImplementedError


_Work = Callable[[Connection], Any]


class Grouping(_Group[_Work]):
    """Write group of a database or of a map.

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
        do : function that writes. It may be called several times. It must not write before it
            raises an error other than `UnusableStore`, since the transaction is committed anyway
        """
        own = copy_context()  # the leader calls the function in the context of this thread
        return cast(T, self._await(lambda connection: own.run(do, connection)))

    def _write_together(self, batch: list[_Waiting[_Work]]) -> None:
        """Perform waiting writes in one transaction; if it fails, in separate transactions."""
        try:
            with self._database.write(map_number=self._map_number) as connection:
                self._take(batch)  # include writes that arrived during the wait for the lock
                for write in batch:
                    _do(write, connection)
        except Exception as error:
            if not batch:  # the lock was not acquired
                self._take(batch, all_=True)
            of_all = isinstance(error, UnusableStore) and not is_conflict(error)
            if len(batch) == 1 or of_all:
                for write in batch:
                    write.result, write.error = None, error
            else:
                for write in batch:
                    try:
                        with self._database.write(map_number=self._map_number) as connection:
                            _do(write, connection)
                    except Exception as own_error:
                        write.result, write.error = None, own_error
                    write.done = True
        for write in batch:
            write.done = True


def _do(write: _Waiting[_Work], connection: Connection) -> None:
    write.result = write.error = None
    try:
        write.result = write.work(connection)
    except UnusableStore:
        raise
    except SceneprintError as error:
        write.error = error


class NewFrames(_Group[NewFrame]):
    """Write group that inserts new frames of all maps with one statement; PostgreSQL only."""

    def __init__(self, database: Database) -> None:
        super().__init__()
        self._database = database

    def receive(self, frame: NewFrame) -> bool:
        """Insert a frame, and return after the commit whether it was inserted.

        If it was not, the caller must write it separately: the frame may exist already, another
        frame of the statement failed, or a map was locked.

        Raises
        ------
        UnusableStore : See `Database.write`.
        """
        return cast(bool, self._await(frame))

    def _write_together(self, batch: list[_Waiting[NewFrame]]) -> None:
        self._take(batch)
        frames = [write.work for write in batch]
        numbers = {write.row.number for write in frames}
        try:
            with self._database.write_maps(numbers, MAPS_WAIT_S) as connection:
                ids = receive_frames(connection, frames)
            for write in batch:
                write.result = write.work.frame_id in ids
        except UnusableStore as error:
            for write in batch:
                write.error = error
        except Exception:  # the separate writes raise the error of the failed frame
            for write in batch:
                write.result = False
        for write in batch:
            write.done = True
