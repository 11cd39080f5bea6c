"""The log of queries: their outcomes, and their answers, which can be opened while they are stored.

SentQuery, Answer | error  --QueryLog.note-->  a file, and a row with others, by a thread of its own
id  --QueryLog.find-->  StoredAnswer

No query waits for its row, and none fails for it. What cannot be written waits in memory while the
database is away; what is lost all the same is logged and counted.
"""

from __future__ import annotations

import logging
import re
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import islice

from sqlalchemy import Connection

from sceneprint.engine.results.query_entry import (
    DAMAGED,
    StoredAnswer,
    decode_answer,
    encode_answer,
    query_record,
    unknown_query,
)
from sceneprint.errors import QuotaExceeded, ReadOnlyStore, SceneprintError, UnusableStore
from sceneprint.settings import Settings
from sceneprint.store import Store
from sceneprint.store.answer_files import AnswerFiles
from sceneprint.store.audit_log import record_change
from sceneprint.store.deletion import DAY_S, remove_in_blocks
from sceneprint.store.maps import find_map, list_maps
from sceneprint.store.query_rows import (
    NewQuery,
    QueryRow,
    WantedQueries,
    add_queries,
    count_kept,
    drop_answers,
    find_query,
    is_current,
    keep_answer,
    list_queries,
    old_queries,
    oldest_answers,
    queries_of_map,
    read_kept,
    release_answer,
    remove_queries,
    set_title,
    shown_frames,
    stored_among,
    stored_bytes,
    surplus_queries,
    unpurged_frames,
)
from sceneprint.store.queue import read_clock
from sceneprint_client.api import Page
from sceneprint_client.api.results import QueryRecord

log = logging.getLogger(__name__)


#: No answer is looked up by anything else.
_ID = re.compile(r"[0-9a-f]{32}")
#: Seconds between two commits of a process. The first query after a pause is written at once.
GATHER_S = 0.1
#: Queries in one commit, and queries that wait while the database is away, with so many bytes of
#: geometry.
AT_ONCE, MOST_WAITING, MOST_WAITING_BYTES = 100, 10_000, 64 << 20
#: Answers that are stored at once.
AT_ONCE_PUT = 8
#: Seconds after which what could not be written is tried again, and that closing waits for it.
AGAIN_S, CLOSING_S = 2.0, 5.0
#: Seconds that a reader waits for queries of this process to be written.
PATIENCE_S = 10.0
#: Seconds between two looks for what has to go, how many rows go after one, and in one commit.
TIDY_S, TIDY_MOST, BLOCK = 60.0, 20_000, 100
#: Queries of a map, and kept answers of a map.
MOST_QUERIES, MOST_KEPT = 100_000, 1000
#: Seconds for which a file may be without its row.
_UNNOTED_S = 60.0
#: Share of the room that a process fills before it looks for what has to go, and that is left free.
_SHARE = 1 / 16


@dataclass(eq=False)
class _Waiting:
    """A query that waits to be written, and its answer, whose geometry has so many bytes."""

    row: NewQuery
    answer: StoredAnswer | None
    size: int


class QueryLog:
    """The queries of one store; safe to share between threads."""

    def __init__(self, store: Store, files: AnswerFiles, settings: Settings) -> None:
        self._store, self._files = store, files
        self._days, self._room = settings.query_log_days, settings.query_log_bytes
        self._waiting: deque[_Waiting] = deque()
        self._changed = threading.Condition()
        self._writer: threading.Thread | None = None
        self._noted = self._settled = self._lost = 0  # queries so far: noted, written or lost
        self._bytes_waiting = self._bytes_written = 0  # the latter since room was made
        self._hurried = self._closed = self._troubled = self._unstorable = False
        self._written_at = -GATHER_S
        self._tidied = time.monotonic()

    @property
    def lost(self) -> int:
        """Queries that were lost since this process began: see its log."""
        return self._lost

    # written

    def note(
        self, row: NewQuery, answer: StoredAnswer | None = None, shown: Sequence[int] = ()
    ) -> None:
        """Have a query written in a moment, with its answer if there is room, and the numbers of
        the frames that the answer shows. Nobody waits, and nothing is raised.
        """
        if self._days == 0 or not (row.listed or (answer is not None and self._room > 0)):
            return
        size = 0 if answer is None else len(answer.geometry or b"")
        with self._changed:
            if self._closed or len(self._waiting) >= MOST_WAITING:
                self._lose(1, "too many wait to be written")
                return
            if self._bytes_waiting + size > MOST_WAITING_BYTES:
                size, answer = 0, None
            self._waiting.append(_Waiting(replace(row, shown=shown), answer, size))
            self._bytes_waiting += size
            self._noted += 1
            if self._writer is None:
                self._writer = threading.Thread(target=self._write, name="query-log", daemon=True)
                self._writer.start()
            if len(self._waiting) == 1:
                self._changed.notify_all()

    def flush(self, wait_s: float = PATIENCE_S) -> bool:
        """Have written at once what was noted so far; False where that takes longer."""
        with self._changed:
            wanted = self._noted
            self._hurried = self._settled < wanted
            self._changed.notify_all()
            return self._changed.wait_for(lambda: self._settled >= wanted, wait_s)

    def close(self) -> None:
        """Write what waits, and accept no more."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        if self._writer is not None:
            self._writer.join(CLOSING_S)
        with self._changed:
            if self._waiting:
                self._lose(len(self._waiting), "the process ends")
                self._waiting.clear()

    def _write(self) -> None:
        """Write queries as they come, until this is closed and none waits."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._closed)
                if not self._waiting:
                    return
                if self._troubled:
                    self._changed.wait_for(lambda: self._closed, AGAIN_S)
                else:
                    since = time.monotonic() - self._written_at
                    self._changed.wait_for(self._is_urgent, max(0.0, GATHER_S - since))
                some = list(islice(self._waiting, AT_ONCE))
            if not self._stored(some) and self._closed:
                return

    def _is_urgent(self) -> bool:
        return self._closed or self._hurried or len(self._waiting) >= AT_ONCE

    def _stored(self, some: Sequence[_Waiting]) -> bool:
        """Write some queries; False where they wait on."""
        why = None
        try:
            self._write_files(some)
            rows = [one.row for one in some if one.row.listed or one.row.bytes]
            with self._store.database.write() as connection:
                add_queries(connection, rows)
            self._bytes_written += sum(one.bytes for one in rows)
        except ReadOnlyStore as error:
            why = str(error)
        except SceneprintError as error:
            if not self._troubled:
                log.warning("queries wait to be logged", extra={"error": str(error)})
            self._troubled = True
            return False
        except Exception:  # a fault of ours must not be met again with the next ones
            log.exception("queries cannot be logged")
            why = "an unexpected error"
        self._written_at = time.monotonic()
        with self._changed:
            for one in some[: len(self._waiting)]:  # none where closing gave them up
                self._waiting.popleft()
                self._bytes_waiting -= one.size
            self._settled += len(some)
            self._hurried = self._hurried and len(self._waiting) > 0
            if why is not None:
                self._lose(len(some), why)
            self._changed.notify_all()
        self._troubled = False
        if self._bytes_written > _SHARE * self._room:
            self.tidy(now=True)
        return True

    def _write_files(self, some: Sequence[_Waiting]) -> None:
        """Store the answers of some queries, several at once as an object store takes its time."""
        if self._store.database.read_only:
            return
        with ThreadPoolExecutor(AT_ONCE_PUT, "query-log-put") as pool:
            list(pool.map(self._write_file, [one for one in some if one.answer is not None]))

    def _write_file(self, one: _Waiting) -> None:
        if one.answer is None or one.row.bytes:  # it was written before the database was away
            return
        data = encode_answer(one.answer)
        if len(data) > self._room:
            return
        try:
            self._files.put(one.row.id, data)
        except (OSError, UnusableStore) as error:
            if not self._unstorable:  # once, and not with every query
                log.warning("answers cannot be stored", extra={"error": str(error)})
            self._unstorable = True
            return
        self._unstorable = False
        one.row = replace(one.row, bytes=len(data))

    def _lose(self, count: int, why: str) -> None:
        self._lost += count
        # the first, and then each time that they are ten times as many: not a line a query
        if len(str(self._lost)) > len(str(self._lost - count)) or self._lost == count:
            log.warning("queries lost", extra={"lost": self._lost, "error": why})

    # read

    def page(
        self, wanted: WantedQueries, names: Collection[str] | None, cursor: str | None, limit: int,
        may_read: Callable[[str], bool] = lambda _: True,
    ) -> Page[QueryRecord]:  # fmt: skip
        """Return queries, the newest first; those that this process answered before are among them.

        Parameters
        ----------
        wanted : which; of which maps, `names` says
        names : of maps, missing ones are passed over; None: of all
        may_read : whether the caller may read a map: the names of others are left out

        Raises
        ------
        InvalidRequest : a cursor that was not given out.
        """
        before = self._store.seals.moment("query", cursor)
        self.flush()
        with self._store.database.read() as connection:
            if names is not None:
                numbers = [row.number for row in list_maps(connection) if row.name in names]
                wanted = replace(wanted, map_numbers=tuple(numbers))
            rows = list_queries(connection, wanted, before, limit + 1)
        more = self._store.seals.next_moment("query", [(r.at, r.number) for r in rows], limit)
        items = [query_record(row, self._days, may_read) for row in rows[:limit]]
        return Page[QueryRecord](items=items, next_cursor=more)

    def find_row(self, query_id: str) -> QueryRow:
        """Return the row of a query whose answer is stored. Raise UnknownQuery if there is none, it
        has expired, or one of its maps or its frame was deleted.
        """
        row = self._current(query_id)
        if row is None:  # it may be on its way, from this process or from another one
            self.flush()
            if not self._store.database.is_sqlite:
                time.sleep(GATHER_S)
            row = self._current(query_id)
        if row is None:
            raise unknown_query(query_id)
        return row

    def _current(self, query_id: str) -> QueryRow | None:
        if not _ID.fullmatch(query_id):
            return None
        with self._store.database.read() as connection:
            row = find_query(connection, query_id)
            stands = row is not None and row.bytes > 0 and is_current(connection, row)
        return row if stands else None

    def find(self, query_id: str) -> StoredAnswer:
        """Return the answer to a query; UnknownQuery as for `find_row`."""
        row = self.find_row(query_id)
        try:
            return decode_answer(self._data(row))
        except DAMAGED:
            raise unknown_query(query_id) from None

    def _data(self, row: QueryRow) -> bytes:
        """Return the bytes of a stored answer; UnknownQuery where they are lost."""
        if row.kept_at is not None:
            with self._store.database.read() as connection:
                data = read_kept(connection, row.number)
        else:
            try:
                data = self._files.get(row.id)
            except OSError:
                data = None
        if data is None:
            raise unknown_query(row.id)
        return data

    def record(
        self, query_id: str, may_read: Callable[[str], bool] = lambda _: True
    ) -> QueryRecord:
        """Return a query whose answer can be looked at; UnknownQuery as for `find_row`."""
        return query_record(self.find_row(query_id), self._days, may_read)

    # kept

    def keep(self, query_id: str, title: str | None) -> QueryRecord:
        """Keep an answer until it is released, or change the title of a kept one. Raise
        UnknownQuery as `find_row` does, and QuotaExceeded if the map keeps as many answers as it
        may.
        """
        row = self.find_row(query_id)
        data = self._data(row)
        with self._store.database.write() as connection:
            if row.kept_at is None:
                self._require_room(connection, row)
                if not keep_answer(connection, row.number, data, read_clock(connection)):
                    raise unknown_query(query_id)  # it was removed meanwhile
            set_title(connection, row.number, title)
            record_change(connection, "answer.kept", row.map, query_id)
        if row.kept_at is None:
            self._delete_files([query_id])
        return self.record(query_id)

    def _require_room(self, connection: Connection, row: QueryRow) -> None:
        count, size = count_kept(connection, row.map)
        if count < MOST_KEPT and size + row.bytes <= self._room / 2:
            return
        raise QuotaExceeded(
            f"Map {row.map!r} keeps {count} of at most {MOST_KEPT} answers, and all kept answers "
            f"have {size} of at most {self._room // 2} bytes, so this one was not kept. Release "
            "some with DELETE /v1/queries/{query_id}/keep, or ask the operator to raise "
            "SCENEPRINT_QUERY_LOG_BYTES."
        )

    def release(self, query_id: str) -> None:
        """Let a kept answer expire; UnknownQuery where it is not kept."""
        row = self.find_row(query_id)
        if row.kept_at is None:
            raise unknown_query(query_id)
        self._files.put(query_id, self._data(row))
        with self._store.database.write() as connection:
            release_answer(connection, row.number)
            record_change(connection, "answer.released", row.map, query_id)

    # removed

    def remove_of_map(self, name: str) -> int:
        """Remove the queries of a map, a few at a time; returns how many. UnknownMap."""
        with self._store.database.read() as connection:
            number = find_map(connection, name).number
        self.flush()
        return self._remove(lambda c, limit: queries_of_map(c, number, limit))

    def tidy(self, *, now: bool = False) -> None:
        """Remove what has to go, if it is time; what cannot be removed is tried again later."""
        if self._store.database.read_only:
            return
        if not now and time.monotonic() - self._tidied < TIDY_S:
            return
        self._tidied, self._bytes_written = time.monotonic(), 0
        try:
            self.remove_surplus()
        except SceneprintError as error:
            log.warning("query removal failed", extra={"error": str(error)})

    def remove_surplus(self) -> int:
        """Remove old and surplus queries, and the oldest answers where there is too little room;
        returns how many.
        """
        with self._store.database.read() as connection:  # as the clock of one host may be wrong
            before = read_clock(connection) - DAY_S * self._days
        removed = self._remove(lambda c, limit: old_queries(c, before, limit))
        removed += self._remove(lambda c, limit: surplus_queries(c, MOST_QUERIES, limit))
        with self._store.database.read() as connection:
            surplus = stored_bytes(connection) - self._room
        if surplus <= 0:
            return removed
        surplus += int(_SHARE * self._room)

        def oldest(connection: Connection, limit: int) -> list[int]:
            nonlocal surplus
            found = []
            for number, size in oldest_answers(connection, limit):
                if surplus <= 0:
                    break
                surplus -= size
                found.append(number)
            return found

        return removed + self._remove(oldest, drop_answers)

    def purge(self) -> int:
        """Remove answers that show a deleted frame which cannot be restored, and files that no
        query needs; returns how many answers.
        """
        self.flush()
        removed, after = 0, 0
        while True:
            with self._store.database.read() as connection:
                some = shown_frames(connection, after, TIDY_MOST)
                there = unpurged_frames(connection, {n for _, shown in some for n in shown})
            gone = [number for number, shown in some if not there.issuperset(shown)]
            for i in range(0, len(gone), BLOCK):
                with self._store.database.write() as connection:
                    dropped = drop_answers(connection, gone[i : i + BLOCK])
                self._delete_files(dropped)
            removed += len(gone)
            if len(some) < TIDY_MOST:
                self._sweep()
                return removed
            after = some[-1][0]

    def _sweep(self) -> None:
        """Remove files that no query needs: a process died before it removed or noted them."""
        before = time.time() - _UNNOTED_S
        names = iter([name for name, at in self._files.list() if at < before])
        while some := list(islice(names, BLOCK)):
            with self._store.database.read() as connection:
                needed = stored_among(connection, some)
            self._files.delete([name for name in some if name not in needed])

    def _remove(
        self, find: Callable[[Connection, int], Sequence[int]],
        remove: Callable[[Connection, Sequence[int]], list[str]] = remove_queries,
    ) -> int:  # fmt: skip
        """Remove rows in blocks, and then the files of their answers."""
        gone: list[str] = []

        def remove_rows(connection: Connection, numbers: Sequence[int]) -> None:
            gone.extend(remove(connection, numbers))

        removed = remove_in_blocks(self._store.database, find, remove_rows, TIDY_MOST, BLOCK)
        for i in range(0, len(gone), BLOCK):
            self._delete_files(gone[i : i + BLOCK])
        return removed

    def _delete_files(self, query_ids: Sequence[str]) -> None:
        """Remove files of answers; those that cannot be removed now are swept later."""
        try:
            self._files.delete(query_ids)
        except (OSError, UnusableStore) as error:
            log.warning("answers cannot be removed", extra={"error": str(error)})
