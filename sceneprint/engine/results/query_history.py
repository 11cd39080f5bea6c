"""The history of queries: a small record of each, written a moment after its answer was given.

Asked, Answer | error  --record_of-->  NewRecord  --QueryHistory.note-->  written together, by a
thread of its own, at most a second later  --QueryHistory.page-->  QueryRecord, ...
NewQueryRecord, ... of a robot  --QueryHistory.add_offline-->  the same, each once

No query waits for its record, and none fails for it. What cannot be written waits in memory while
the database is away; what is lost all the same is logged and counted.
"""

from __future__ import annotations

import logging
import threading
import time
import uuid
from collections import deque
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import NamedTuple

from sceneprint.engine.serializers import when
from sceneprint.errors import ReadOnlyStore, SceneprintError
from sceneprint.settings import Settings
from sceneprint.store import Store
from sceneprint.store.answer_rows import KeptRow, kept_among
from sceneprint.store.audit_log import record_change
from sceneprint.store.deletion import DAY_S, remove_in_blocks
from sceneprint.store.maps import find_map, list_maps
from sceneprint.store.query_records import (
    NewRecord,
    RecordRow,
    WantedRecords,
    add_offline_records,
    add_records,
    list_records,
    names_of,
    old_records,
    records_of_former_keys,
    records_of_map,
    remove_records,
    surplus_records,
)
from sceneprint.store.queue import read_clock
from sceneprint_client.api import Answer, FrameName, Page, Query
from sceneprint_client.api.base import Quaternion, Vector
from sceneprint_client.api.frames import Kind
from sceneprint_client.api.results import (
    KeptAnswer,
    NewQueryRecord,
    NewQueryRecords,
    QueryRecord,
    QueryRecordsAdded,
    RecordedPose,
    RecordStatus,
    RefusedRecord,
)
from sceneprint_client.errors import kebab_case

log = logging.getLogger(__name__)

# What came of a query, as a record.


@dataclass(frozen=True)
class AskedQuery:
    """A query as it came, and who asked.

    Parameters
    ----------
    maps : names of those that are asked, one or more
    query : how
    robot, session : who asks, in which run
    key_id : of the key that was shown
    frame : the stored frame that is asked for
    at : when it came, seconds since 1970
    """

    maps: Sequence[str]
    query: Query
    robot: str | None = None
    session: str | None = None
    key_id: str | None = None
    frame: FrameName | None = None
    at: float = 0.0


def record_of(asked: AskedQuery, came_of_it: Answer | Exception, seconds: float) -> NewRecord:
    """The record of a query that was answered, or that failed with an error."""
    failed = isinstance(came_of_it, Exception)
    one = _failure(came_of_it) if isinstance(came_of_it, Exception) else _success(came_of_it)
    frame, several = asked.frame, len(asked.maps) > 1
    return NewRecord(
        # as exact as JSON tells it: who asks for what came before a record's time is not told of it
        id=one.query_id, at=round(asked.at, 6), map=(several and one.map) or asked.maps[0],
        maps=tuple(asked.maps) if several else None, robot=asked.robot,
        session=asked.session, key_id=asked.key_id, status=one.status, cause=one.cause,
        reason=one.reason, pose_parent=one.pose_parent, pose=one.pose, support=one.support,
        rival_ratio=one.rival_ratio, alternatives=one.alternatives,
        milliseconds=round(1e3 * seconds, 2), kind=one.kind,
        frame_map=None if frame is None else frame.map,
        frame_id=None if frame is None else frame.frame_id,
        kept=asked.query.keep and not failed,
    )  # fmt: skip


def offline_record(map_name: str, one: NewQueryRecord, key_id: str | None) -> NewRecord:
    """The record of a query that a robot answered itself, as the robot sends it.

    Parameters
    ----------
    map_name : of the map that it belongs to
    one : see NewQueryRecord
    key_id : of the key that was shown
    """
    pose = one.pose
    t, r = (None, None) if pose is None else (pose.translation, pose.rotation)
    return NewRecord(
        id=one.query_id, at=round(one.at.timestamp(), 6), map=map_name,
        maps=None if one.maps is None else tuple(one.maps), robot=one.robot, session=one.session,
        key_id=key_id, status=one.status, cause=one.cause, reason=one.reason,
        pose_parent=None if pose is None else pose.parent_frame,
        pose=None if t is None or r is None else (t.x, t.y, t.z, r.x, r.y, r.z, r.w),
        support=one.support, rival_ratio=one.rival_ratio, alternatives=one.alternatives,
        milliseconds=one.milliseconds, kind=one.kind,
        frame_map=None if one.frame is None else one.frame.map,
        frame_id=None if one.frame is None else one.frame.frame_id, kept=False, offline=True,
    )  # fmt: skip


class RecordedOutcome(NamedTuple):
    """Those fields of a record that what came of the query decides; see NewRecord."""

    query_id: str
    status: RecordStatus
    reason: str
    cause: str | None
    kind: Kind | None = None
    map: str | None = None
    pose_parent: str | None = None
    pose: tuple[float, ...] | None = None
    support: int | None = None
    rival_ratio: float | None = None
    alternatives: int = 0


def _success(answer: Answer) -> RecordedOutcome:
    there = answer.location
    named = [there, *answer.alternatives, *answer.matches]
    found = RecordedOutcome(
        answer.query_id, answer.status, answer.reason, answer.cause, answer.kind,
        next((one.map for one in named if one is not None and one.map is not None), None),
        alternatives=len(answer.alternatives),
    )  # fmt: skip
    if there is None:
        return found
    t, r = there.pose.translation, there.pose.rotation
    return found._replace(
        pose_parent=there.pose.parent_frame, pose=(t.x, t.y, t.z, r.x, r.y, r.z, r.w),
        support=there.support, rival_ratio=there.rival_ratio,
    )  # fmt: skip


def _failure(error: Exception) -> RecordedOutcome:
    known = isinstance(error, SceneprintError)
    reason = str(error) if known else "the service failed; its log has the traceback"
    cause = kebab_case(type(error).__name__) if known else "internal-error"
    return RecordedOutcome(uuid.uuid4().hex, "failed", reason, cause)


# Records on their way to the database, and out of it again.

#: Seconds from the first record that waits until all are written together.
GATHER_S = 0.5
#: Records in one commit, and records that wait while the database is away: 20 MB or so.
AT_ONCE, MOST_WAITING = 500, 10_000
#: Seconds after which what could not be written is tried again, and that closing waits for it.
AGAIN_S, CLOSING_S = 2.0, 5.0
#: Seconds between two looks for records that are no longer kept, and how many go after one.
TIDY_S, TIDY_MOST = 60.0, 20_000


class QueryHistory:
    """The records of one store; safe to share between threads.

    Parameters
    ----------
    store : see Store
    settings : how long they are kept, and how many
    """

    def __init__(self, store: Store, settings: Settings) -> None:
        self._store, self._settings = store, settings
        self._waiting: deque[NewRecord] = deque()
        self._changed = threading.Condition()
        self._writer: threading.Thread | None = None
        self._noted = self._settled = self._lost = 0  # records so far: noted, written or lost
        self._hurried = self._closed = self._troubled = False
        self._tidied = time.monotonic()

    @property
    def lost(self) -> int:
        """Records that were lost since this process began: see its log."""
        return self._lost

    # written

    def note(self, record: NewRecord) -> None:
        """Have a record written in a moment; nobody waits, and nothing is raised."""
        if self._settings.history_days == 0:
            return
        with self._changed:
            if self._closed or len(self._waiting) >= MOST_WAITING:
                self._lose(1, "too many wait to be written")
                return
            self._waiting.append(record)
            self._noted += 1
            if self._writer is None:
                self._writer = threading.Thread(target=self._write, name="history", daemon=True)
                self._writer.start()
            if len(self._waiting) == 1:
                self._changed.notify_all()

    def flush(self, wait_s: float) -> bool:
        """Have written at once what was noted so far; False where that takes longer."""
        with self._changed:
            wanted = self._noted
            self._hurried = self._settled < wanted
            self._changed.notify_all()
            return self._changed.wait_for(lambda: self._settled >= wanted, wait_s)

    def close(self) -> None:
        """Write what waits, and take no more."""
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
        """Write records as they come, until this is closed and none waits."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._closed)
                if not self._waiting:
                    return
                if self._troubled:
                    self._changed.wait_for(lambda: self._closed, AGAIN_S)
                else:
                    self._changed.wait_for(self._is_urgent, GATHER_S)
                some = list(islice(self._waiting, AT_ONCE))
            if not self._stored(some) and self._closed:
                return

    def _is_urgent(self) -> bool:
        return self._closed or self._hurried or len(self._waiting) >= AT_ONCE

    def _stored(self, some: Sequence[NewRecord]) -> bool:
        """Write some records; False where they wait on."""
        why = None
        try:
            with self._store.database.write() as connection:
                add_records(connection, some)
        except ReadOnlyStore as error:
            why = str(error)
        except SceneprintError as error:
            if not self._troubled:
                log.warning("query records wait to be written", extra={"error": str(error)})
            self._troubled = True
            return False
        except Exception:  # a fault of ours must not be met again with the next ones
            log.exception("query records cannot be written")
            why = "an unexpected error"
        with self._changed:
            for _ in range(min(len(some), len(self._waiting))):  # none where closing gave them up
                self._waiting.popleft()
            self._settled += len(some)
            self._hurried = self._hurried and len(self._waiting) > 0
            if why is not None:
                self._lose(len(some), why)
            self._changed.notify_all()
        self._troubled = False
        return True

    def _lose(self, count: int, why: str) -> None:
        self._lost += count
        # the first, and then each time that they are ten times as many: not a line a query
        if len(str(self._lost)) > len(str(self._lost - count)) or self._lost == count:
            log.warning("query records lost", extra={"lost": self._lost, "error": why})

    def add_offline(
        self, map_name: str, given: NewQueryRecords, key_id: str | None
    ) -> QueryRecordsAdded:
        """Store records of queries that a robot answered itself, each once.

        Parameters
        ----------
        map_name : of the map that they belong to
        given : the records
        key_id : of the key that was shown; the records go with it

        Raises
        ------
        UnknownMap : there is none of that name.
        ReadOnlyStore, StoreLocked, StoreFull, UnusableStore : nothing was stored.
        """
        new = [offline_record(map_name, one, key_id) for one in given.records]
        kept_s = DAY_S * self._settings.history_days
        with self._store.database.write() as connection:
            row = find_map(connection, map_name)
            done = add_offline_records(
                connection, row, new, kept_s, self._settings.history_queries
            )  # fmt: skip
            if done.received:
                record_change(connection, "queries.added", map_name, received=done.received)
        refused = [RefusedRecord(query_id=one, reason=why) for one, why in done.refused.items()]
        return QueryRecordsAdded(
            received=done.received, there=done.there, expired=done.expired, refused=refused
        )

    # read

    def page(
        self, wanted: WantedRecords, names: Collection[str] | None, cursor: str | None, limit: int,
        may_read: Callable[[str], bool] = lambda _: True,
    ) -> Page[QueryRecord]:  # fmt: skip
        """Records, the newest first; what this process answered before is among them.

        Parameters
        ----------
        wanted : which; of which maps, `names` says
        names : of maps, those that are not there are passed over; None: of all
        cursor, limit : of the page
        may_read : whether the caller may read a map: the names of others are not told

        Raises
        ------
        InvalidRequest : a cursor that was not given out.
        """
        before = self._store.seals.moment("query", cursor)
        self.flush(_PATIENCE_S)
        with self._store.database.read() as connection:
            if names is not None:
                numbers = [row.number for row in list_maps(connection) if row.name in names]
                wanted = replace(wanted, map_numbers=tuple(numbers))
            rows = list_records(connection, wanted, before, limit + 1)
            of_maps, of_keys = names_of(connection, rows)
            kept = {
                name: kept_record(row)
                for name, row in kept_among(connection, [row.id for row in rows]).items()
            }
        more = self._store.seals.next_moment("query", [(r.at, r.number) for r in rows], limit)
        told = [
            query_record(
                row, of_maps[row.map_number], of_keys.get(row.key_id or ""),
                row.at + self._settings.query_s, may_read, kept.get(row.id),
            )
            for row in rows[:limit]
        ]  # fmt: skip
        return Page[QueryRecord](items=told, next_cursor=more)

    # removed

    def remove_of_map(self, name: str) -> int:
        """Remove the records of a map, a few at a time; returns how many. UnknownMap."""
        with self._store.database.read() as connection:
            number = find_map(connection, name).number
        self.flush(_PATIENCE_S)
        return remove_in_blocks(
            self._store.database, lambda c, limit: records_of_map(c, number, limit), remove_records
        )

    def remove_of_former_keys(self) -> int:
        """Remove the records of keys that are gone, a few at a time; returns how many."""
        return remove_in_blocks(self._store.database, records_of_former_keys, remove_records)

    def tidy(self) -> int:
        """Remove records that are no longer kept, if it is time; returns how many.

        Where that cannot be written, nothing is lost: it is tried again the next time.
        """
        if time.monotonic() - self._tidied < TIDY_S or self._store.database.read_only:
            return 0
        self._tidied = time.monotonic()
        try:
            return self.remove_spent()
        except SceneprintError as error:
            log.warning("query record removal failed", extra={"error": str(error)})
            return 0

    def remove_spent(self) -> int:
        """Remove records that are no longer kept, a few at a time; returns how many."""
        database, kept = self._store.database, self._settings.history_queries
        with database.read() as connection:  # as the clock of one host may be wrong
            before = read_clock(connection) - DAY_S * self._settings.history_days
        old = remove_in_blocks(
            database, lambda c, limit: old_records(c, before, limit), remove_records, TIDY_MOST
        )
        surplus = remove_in_blocks(
            database, lambda c, limit: surplus_records(c, kept, limit), remove_records, TIDY_MOST
        )
        return old + surplus + self.remove_of_former_keys()


#: Seconds that a list waits for what was just answered to be written.
_PATIENCE_S = 1.0


def query_record(
    row: RecordRow, map_name: str, key: str | None, until: float | None,
    may_read: Callable[[str], bool], keep: KeptAnswer | None = None,
) -> QueryRecord:  # fmt: skip
    """A record as JSON tells it.

    Parameters
    ----------
    row : see RecordRow
    map_name : of the map that it belongs to
    key : name of the key that was shown
    until : when an answer that nobody keeps goes, seconds since 1970
    may_read : whether the caller may read a map: the names of others are not told
    keep : how its answer is kept
    """
    frame = None
    if row.frame_id is not None and row.frame_map is not None and may_read(row.frame_map):
        frame = FrameName(map=row.frame_map, frame_id=row.frame_id)
    stays = row.kept and until is not None and until > time.time()
    return QueryRecord(
        query_id=row.id, at=when(row.at), map=map_name,
        maps=[map_name] if row.maps is None else [one for one in row.maps if may_read(one)],
        robot=row.robot, session=row.session, key=key, status=row.status, cause=row.cause,
        reason=row.reason, pose=_pose(row), support=row.support, rival_ratio=row.rival_ratio,
        alternatives=row.alternatives, milliseconds=row.milliseconds, kind=row.kind, frame=frame,
        kept_until=when(until) if stays else None, keep=keep, offline=bool(row.offline),
    )  # fmt: skip


def kept_record(row: KeptRow) -> KeptAnswer:
    """How an answer is kept, as JSON tells it."""
    until = None if row.until is None else when(row.until)
    return KeptAnswer(title=row.title, kept_at=when(row.kept_at), until=until, bytes=row.bytes)


def _pose(row: RecordRow) -> RecordedPose | None:
    if row.pose is None or row.pose_parent is None:
        return None
    x, y, z, qx, qy, qz, qw = row.pose
    return RecordedPose(
        parent_frame=row.pose_parent, translation=Vector(x=x, y=y, z=z),
        rotation=Quaternion(x=qx, y=qy, z=qz, w=qw),
    )  # fmt: skip
