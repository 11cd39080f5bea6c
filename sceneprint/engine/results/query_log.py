"""Query log: outcomes of queries, and answers until they expire.

NewQuery, StoredAnswer  --QueryLog.note, then a thread-->  row and file
id  --QueryLog.find-->  StoredAnswer

Logging never delays a query or makes it fail. While the database is unreachable, entries wait in
memory; lost entries are logged and counted.
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
    read_permanent_answer,
    release_answer,
    remove_queries,
    set_title,
    shown_frames,
    stored_answer_ids,
    stored_bytes,
    surplus_queries,
    unpurged_frames,
)
from sceneprint.store.queue import read_clock
from sceneprint_client.api import Page
from sceneprint_client.api.results import QueryRecord

log = logging.getLogger(__name__)


#: Format of query ids.
_ID = re.compile(r"[0-9a-f]{32}")
#: Minimum seconds between commits of a process; the first query after a pause is written at once.
GATHER_S = 0.1
#: Maximum number of queries per commit, and of waiting queries; maximum total size of the
#: geometries of waiting queries, bytes.
AT_ONCE, MOST_WAITING, MOST_WAITING_BYTES = 100, 10_000, 64 << 20
#: Number of answers to write concurrently.
AT_ONCE_PUT = 8
#: Seconds between attempts to write queries, and maximum seconds that `close` waits.
AGAIN_S, CLOSING_S = 2.0, 5.0
#: Maximum seconds that a reader waits for queries of this process to be written.
PATIENCE_S = 10.0
#: Seconds between removals, and maximum number of rows per removal and per commit.
TIDY_S, TIDY_MOST, BLOCK = 60.0, 20_000, 100
#: Maximum number of queries, and of permanent answers, per map.
MOST_QUERIES, MOST_KEPT = 100_000, 1000
#: Minimum age, in seconds, at which a file without a row is removed.
_ORPHAN_S = 60.0
#: Share of the space for answers. After this much was written, space is checked; if it is used up,
#: the oldest answers are removed until this much is free.
_SHARE = 1 / 16


@dataclass(eq=False)
class _Waiting:
    """A query to be written, its answer, and the size of the geometry, bytes."""

    row: NewQuery
    answer: StoredAnswer | None
    size: int


class QueryLog:
    """The query log of a store; safe to share between threads."""

    def __init__(self, store: Store, files: AnswerFiles, settings: Settings) -> None:
        self._store, self._files = store, files
        self._days, self._room = settings.query_log_days, settings.query_log_bytes
        self._waiting: deque[_Waiting] = deque()
        self._changed = threading.Condition()
        self._writer: threading.Thread | None = None
        self._queued = self._settled = self._lost = 0  # total numbers of queries
        self._bytes_waiting = self._bytes_written = 0  # written since the last removal
        self._flushing = self._closed = self._retrying = self._unstorable = False
        self._written_at = -GATHER_S
        self._tidied = time.monotonic()

    @property
    def lost(self) -> int:
        """Number of queries that this process could not log."""
        return self._lost

    def note(
        self, row: NewQuery, answer: StoredAnswer | None = None, shown: Sequence[int] = ()
    ) -> None:
        """Queue a query for the log, with its answer if memory permits, without waits or errors.

        Do nothing if the log is disabled; count the query as lost if too many queries wait.

        Parameters
        ----------
        shown : frame numbers in the answer
        """
        if self._days == 0 or not (row.listed or (answer is not None and self._room > 0)):
            return
        size = 0 if answer is None else len(answer.geometry or b"")
        with self._changed:
            if self._closed or len(self._waiting) >= MOST_WAITING:
                self._lose(1, "too many queries are waiting")
                return
            if self._bytes_waiting + size > MOST_WAITING_BYTES:
                size, answer = 0, None
            self._waiting.append(_Waiting(replace(row, shown=shown), answer, size))
            self._bytes_waiting += size
            self._queued += 1
            if self._writer is None:
                self._writer = threading.Thread(target=self._write, name="query-log", daemon=True)
                self._writer.start()
            if len(self._waiting) == 1:
                self._changed.notify_all()

    def flush(self, wait_s: float = PATIENCE_S) -> bool:
        """Wait until queued queries are written; return False after `wait_s` seconds."""
        with self._changed:
            target = self._queued
            self._flushing = self._settled < target
            self._changed.notify_all()
            return self._changed.wait_for(lambda: self._settled >= target, wait_s)

    def close(self) -> None:
        """Accept no more queries; after CLOSING_S seconds, count unwritten ones as lost."""
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
        """Write queued queries in batches until the log is closed."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._closed)
                if not self._waiting:
                    return
                if self._retrying:
                    self._changed.wait_for(lambda: self._closed, AGAIN_S)
                else:
                    since = time.monotonic() - self._written_at
                    self._changed.wait_for(
                        lambda: self._closed or self._flushing or len(self._waiting) >= AT_ONCE,
                        max(0.0, GATHER_S - since),
                    )
                batch = list(islice(self._waiting, AT_ONCE))
            if not self._write_batch(batch) and self._closed:
                return

    def _write_batch(self, batch: Sequence[_Waiting]) -> bool:
        """Write a batch of queries; return False if the caller must retry."""
        loss_reason = None
        try:
            if not self._store.database.read_only:
                # write concurrently, since object stores are slow
                with ThreadPoolExecutor(AT_ONCE_PUT, "query-log-put") as pool:
                    list(pool.map(self._write_file, [entry for entry in batch if entry.answer]))
            rows = [entry.row for entry in batch if entry.row.listed or entry.row.bytes]
            with self._store.database.write() as connection:
                add_queries(connection, rows)
            self._bytes_written += sum(row.bytes for row in rows)
        except ReadOnlyStore as error:
            loss_reason = str(error)
        except SceneprintError as error:
            if not self._retrying:
                log.warning("queries wait to be logged", extra={"error": str(error)})
            self._retrying = True
            return False
        except Exception:  # a retry would repeat a programming error
            log.exception("queries cannot be logged")
            loss_reason = "an unexpected error"
        self._written_at = time.monotonic()
        with self._changed:
            for waiting in batch[: len(self._waiting)]:  # `close` may have emptied the list
                self._waiting.popleft()
                self._bytes_waiting -= waiting.size
            self._settled += len(batch)
            self._flushing = self._flushing and len(self._waiting) > 0
            if loss_reason is not None:
                self._lose(len(batch), loss_reason)
            self._changed.notify_all()
        self._retrying = False
        if self._bytes_written > _SHARE * self._room:
            self.tidy(now=True)
        return True

    def _write_file(self, entry: _Waiting) -> None:
        if entry.answer is None or entry.row.bytes:  # stored by an earlier attempt
            return
        data = encode_answer(entry.answer)
        if len(data) > self._room:
            return
        try:
            self._files.put(entry.row.id, data)
        except (OSError, UnusableStore) as error:
            if not self._unstorable:  # log only the first of consecutive failures
                log.warning("answers cannot be stored", extra={"error": str(error)})
            self._unstorable = True
            return
        self._unstorable = False
        entry.row = replace(entry.row, bytes=len(data))

    def _lose(self, count: int, reason: str) -> None:
        self._lost += count
        # log the first loss, and each increase of the number of digits
        if len(str(self._lost)) > len(str(self._lost - count)) or self._lost == count:
            log.warning("queries lost", extra={"lost": self._lost, "error": reason})

    def page(
        self, query_filter: WantedQueries, names: Collection[str] | None, cursor: str | None,
        limit: int, may_read: Callable[[str], bool] = lambda _: True,
    ) -> Page[QueryRecord]:  # fmt: skip
        """Return a page of queries, newest first, including unwritten queries of this process.

        Parameters
        ----------
        query_filter : filter of the queries, without maps
        names : names of the maps; unknown names are ignored, and None selects all maps
        may_read : see `query_record`

        Raises
        ------
        InvalidRequest : If the service did not issue the cursor.
        """
        before = self._store.seals.moment("query", cursor)
        self.flush()
        with self._store.database.read() as connection:
            if names is not None:
                numbers = [row.number for row in list_maps(connection) if row.name in names]
                query_filter = replace(query_filter, map_numbers=tuple(numbers))
            rows = list_queries(connection, query_filter, before, limit + 1)
        more = self._store.seals.next_moment("query", [(r.at, r.number) for r in rows], limit)
        items = [query_record(row, self._days, may_read) for row in rows[:limit]]
        return Page[QueryRecord](items=items, next_cursor=more)

    def find_row(self, query_id: str) -> QueryRow:
        """Return the row of a query whose answer is stored.

        Raise UnknownQuery if the answer does not exist or has expired, or one of its maps or its
        frame was deleted.
        """
        row = self._current(query_id)
        if row is None:  # it may not be written yet
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
        """Return the answer to a query; see `find_row` for errors."""
        row = self.find_row(query_id)
        try:
            return decode_answer(self._data(row))
        except DAMAGED:
            raise unknown_query(query_id) from None

    def _data(self, row: QueryRow) -> bytes:
        """Return the encoded answer to a query; raise UnknownQuery if it is lost."""
        if row.kept_at is not None:
            with self._store.database.read() as connection:
                data = read_permanent_answer(connection, row.number)
        else:
            try:
                data = self._files.get(row.id)
            except OSError:
                data = None
        if data is None:
            raise unknown_query(row.id)
        return data

    def record(self, query_id: str) -> QueryRecord:
        """Return the API record of a query; see `find_row` for errors."""
        return query_record(self.find_row(query_id), self._days, lambda _: True)

    def keep(self, query_id: str, title: str | None) -> QueryRecord:
        """Make an answer permanent until `release`, set its title, and return its record.

        Raises
        ------
        UnknownQuery : See `find_row`.
        QuotaExceeded : If the map has no room for another permanent answer.
        """
        row = self.find_row(query_id)
        data = self._data(row)
        with self._store.database.write() as connection:
            if row.kept_at is None:
                self._require_room(connection, row)
                if not keep_answer(connection, row.number, data, read_clock(connection)):
                    raise unknown_query(query_id)
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
            f"The answer cannot be kept: map {row.map!r} has {count} of at most {MOST_KEPT} kept "
            f"answers, and the kept answers of all maps have {size} of at most {self._room // 2} "
            "bytes. Release answers with DELETE /v1/queries/{query_id}/keep, or ask the operator "
            "to raise SCENEPRINT_QUERY_LOG_BYTES."
        )

    def release(self, query_id: str) -> None:
        """Make a permanent answer expire again; raise UnknownQuery if it is not permanent."""
        row = self.find_row(query_id)
        if row.kept_at is None:
            raise unknown_query(query_id)
        self._files.put(query_id, self._data(row))
        with self._store.database.write() as connection:
            release_answer(connection, row.number)
            record_change(connection, "answer.released", row.map, query_id)

    def remove_of_map(self, name: str) -> int:
        """Remove all queries of a map in blocks; return the number of queries.

        Raise UnknownMap if the map does not exist.
        """
        with self._store.database.read() as connection:
            number = find_map(connection, name).number
        self.flush()
        return self._remove(lambda c, limit: queries_of_map(c, number, limit))

    def tidy(self, *, now: bool = False) -> None:
        """Call `remove_surplus` every TIDY_S seconds, or with `now`; log errors."""
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
        """Remove expired and surplus queries, and the oldest answers if space is short.

        Return the number of removed queries and answers.
        """
        with self._store.database.read() as connection:
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
            numbers = []
            for number, size in oldest_answers(connection, limit):
                if surplus <= 0:
                    break
                surplus -= size
                numbers.append(number)
            return numbers

        return removed + self._remove(oldest, drop_answers)

    def purge(self) -> int:
        """Remove answers that contain purged frames, and files without a row.

        Return the number of removed answers.
        """
        self.flush()
        removed, after = 0, 0
        while True:
            with self._store.database.read() as connection:
                batch = shown_frames(connection, after, TIDY_MOST)
                unpurged = unpurged_frames(connection, {n for _, shown in batch for n in shown})
            expired = [number for number, shown in batch if not unpurged.issuperset(shown)]
            for i in range(0, len(expired), BLOCK):
                with self._store.database.write() as connection:
                    dropped = drop_answers(connection, expired[i : i + BLOCK])
                self._delete_files(dropped)
            removed += len(expired)
            if len(batch) < TIDY_MOST:
                self._sweep()
                return removed
            after = batch[-1][0]

    def _sweep(self) -> None:
        """Remove files without a row, which killed processes left."""
        before = time.time() - _ORPHAN_S
        names = iter([name for name, at in self._files.list() if at < before])
        while batch := list(islice(names, BLOCK)):
            with self._store.database.read() as connection:
                needed = stored_answer_ids(connection, batch)
            self._files.delete([name for name in batch if name not in needed])

    def _remove(
        self, find: Callable[[Connection, int], Sequence[int]],
        remove: Callable[[Connection, Sequence[int]], list[str]] = remove_queries,
    ) -> int:  # fmt: skip
        """Remove, in blocks, the rows that `find` returns and their files; return the row count."""
        query_ids: list[str] = []

        def remove_rows(connection: Connection, numbers: Sequence[int]) -> None:
            query_ids.extend(remove(connection, numbers))

        removed = remove_in_blocks(self._store.database, find, remove_rows, TIDY_MOST, BLOCK)
        for i in range(0, len(query_ids), BLOCK):
            self._delete_files(query_ids[i : i + BLOCK])
        return removed

    def _delete_files(self, query_ids: Sequence[str]) -> None:
        """Remove files of answers; after an error, `_sweep` removes the rest."""
        try:
            self._files.delete(query_ids)
        except (OSError, UnusableStore) as error:
            log.warning("answers cannot be removed", extra={"error": str(error)})
