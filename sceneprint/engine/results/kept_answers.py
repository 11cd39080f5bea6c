"""Answers that are kept until somebody releases them: the database has their rows, blobs the rest.

query id  --keep-->  row and blob  --find-->  StoredResult  --release-->  nothing

Other answers are gone after an hour (`stored_results`). A kept one goes with a map that it was
asked of, and with a frame that it shows.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, fields, replace
from typing import Any

from sqlalchemy import Connection, select

from sceneprint.engine.results.query_history import (
    AskedQuery,
    kept_record,
    query_record,
    record_of,
)
from sceneprint.engine.results.stored_results import (
    DAMAGED,
    StoredResult,
    StoredResults,
    read,
    unknown_query,
    written,
)
from sceneprint.engine.serializers import when
from sceneprint.engine.upkeep.garbage_collection import collect_deleted_blobs
from sceneprint.errors import Conflict, DamagedBlob, InvalidRequest, QuotaExceeded
from sceneprint.settings import Settings
from sceneprint.store import Store
from sceneprint.store.answer_rows import (
    KeptRow,
    NewKeptAnswer,
    count_kept,
    edit_kept_answer,
    expired_answer,
    find_answer,
    keep_answer,
    list_answers,
    remove_answers,
    spent_answers,
)
from sceneprint.store.audit_log import record_change
from sceneprint.store.deletion import BLOCK, doom
from sceneprint.store.frame_queries import QueryOrigin
from sceneprint.store.maps import find_map, find_maps, list_maps, map_of
from sceneprint.store.query_records import RecordRow, WantedRecords, record_of_answer
from sceneprint.store.tables import MapRow, frames
from sceneprint_client.api import FrameState, Page
from sceneprint_client.api.results import AnswerRetention, KeepOptions, QueryRecord


class KeptAnswers:
    """The kept answers of one store; safe to share between threads.

    Parameters
    ----------
    store : see Store
    settings : how many a map may have, and how many bytes of them
    """

    def __init__(self, store: Store, settings: Settings) -> None:
        self._store, self._settings = store, settings

    def find(self, query_id: str) -> StoredResult | None:
        """A kept answer as it was stored; None where it is not kept, or damaged."""
        with self._store.database.read() as connection:
            row = find_answer(connection, query_id)
        if row is None:
            return None
        try:
            return read(self._store.blobs.get(row.blob))
        except (DamagedBlob, *DAMAGED):  # `sceneprint fsck` tells of it
            return None

    def keep(self, results: StoredResults, query_id: str, options: KeepOptions) -> AnswerRetention:
        """Keep an answer; one that is kept gets this title and end.

        Parameters
        ----------
        results : where answers are that are not kept
        query_id : of the answer
        options : its title, and until when

        Raises
        ------
        UnknownQuery : it is not there any more.
        Conflict : a frame that it shows was deleted.
        QuotaExceeded : a map has as many kept answers, or bytes of them, as it may have.
        InvalidRequest : the end has passed.
        """
        until = None if options.until is None else options.until.timestamp()
        if until is not None and until <= time.time():
            raise InvalidRequest(
                "`until` has passed, so the answer was not kept. Give a later time, or leave it "
                "out to keep the answer until it is released.",
                (("until", "has passed"),),
            )
        found = results.find(query_id)
        data = written(found)
        while True:
            blob = self._store.blobs.put(data)
            with self._store.database.write() as connection:
                row = find_answer(connection, query_id)
                if row is not None:
                    row = edit_kept_answer(connection, row, options.title, until)
                elif self._store.blobs.holds(blob):  # else a removal came first
                    doom(
                        connection, remove_answers(connection, expired_answer(connection, query_id))
                    )
                    new = self._described(connection, found, blob, len(data))
                    row = keep_answer(connection, new, options.title, until)
                if row is not None:
                    record_change(connection, "answer.kept", None, query_id)
            if row is not None:
                return _retention(row)

    def _described(
        self, connection: Connection, found: StoredResult, blob: str, size: int
    ) -> NewKeptAnswer:
        answer = found.answer
        of_maps = {row.name: row for row in find_maps(connection, list(dict.fromkeys(answer.maps)))}
        for row in of_maps.values():
            self._require_room(connection, row, size)
        shown = {(one.map, one.frame_id) for one in answer.matches}
        if answer.frame is not None:
            shown.add((answer.frame.map, answer.frame.frame_id))
        numbers = [_number_of(connection, of_maps, *place) for place in sorted(shown)]
        asked = [one.number for one in of_maps.values()]
        record = _record(connection, found, asked)
        return NewKeptAnswer(
            answer.query_id, blob, size, record["at"], record["status"], record["robot"], record,
            asked, numbers,
        )  # fmt: skip

    def _require_room(self, connection: Connection, row: MapRow, size: int) -> None:
        count, held = count_kept(connection, row.number)
        most, most_bytes = self._settings.kept_answers, self._settings.kept_bytes
        if count < most and held + size <= most_bytes:
            return
        raise QuotaExceeded(
            f"Map {row.name!r} keeps {count} answers of {held} bytes, and at most {most} of "
            f"{most_bytes} bytes may be kept, so this one was not. Release some with "
            "DELETE /v1/queries/{query_id}/keep, or ask the operator to raise "
            "SCENEPRINT_KEPT_ANSWERS or SCENEPRINT_KEPT_BYTES."
        )

    def retention(self, results: StoredResults, query_id: str) -> AnswerRetention:
        """For how long an answer is there; UnknownQuery where it is not."""
        with self._store.database.read() as connection:
            row = find_answer(connection, query_id)
        if row is not None:
            return _retention(row)
        until = results.find(query_id).at + self._settings.query_s
        return AnswerRetention(query_id=query_id, kept=False, until=when(until))

    def release(self, query_id: str) -> None:
        """Keep an answer no longer; UnknownQuery where it is not kept."""
        with self._store.database.write() as connection:
            row = find_answer(connection, query_id)
            if row is None:
                raise unknown_query(query_id)
            blobs = remove_answers(connection, [row.number])
            doom(connection, blobs)
            record_change(connection, "answer.released", None, query_id)
        collect_deleted_blobs(self._store, blobs)

    def page(
        self, wanted: WantedRecords, names: tuple[str, ...] | None, map_name: str | None,
        cursor: str | None, limit: int,
    ) -> Page[QueryRecord]:  # fmt: skip
        """Records of kept answers, those of the newest queries first.

        Parameters
        ----------
        wanted : which
        names : of all maps that the caller may read; None: it reads every map
        map_name : only answers that this map was asked for
        cursor, limit : of the page

        Raises
        ------
        UnknownMap : there is none of that name.
        InvalidRequest : a cursor that was not given out.
        """
        before = self._store.seals.moment("query", cursor)
        with self._store.database.read() as connection:
            named = None if map_name is None else find_map(connection, map_name).number
            if names is not None:
                numbers = [row.number for row in list_maps(connection) if row.name in names]
                wanted = replace(wanted, map_numbers=tuple(numbers))
            rows = list_answers(connection, wanted, named, before, limit + 1)
        more = self._store.seals.next_moment("query", [(r.at, r.number) for r in rows], limit)

        def may_read(name: str) -> bool:
            return names is None or name in names

        told = [_listed(row, may_read) for row in rows[:limit]]
        return Page[QueryRecord](items=told, next_cursor=more)

    def remove_spent(self) -> int:
        """Remove answers whose time is over, or that show a deleted frame; returns how many."""
        removed = 0
        while True:
            with self._store.database.read() as connection:  # most often there is none: no lock
                if not spent_answers(connection, 1):
                    return removed
            with self._store.database.write() as connection:
                numbers = spent_answers(connection, BLOCK)
                blobs = remove_answers(connection, numbers)
                doom(connection, blobs)
            collect_deleted_blobs(self._store, blobs)
            removed += len(numbers)


def _retention(row: KeptRow) -> AnswerRetention:
    told = kept_record(row)
    return AnswerRetention(
        query_id=row.id, kept=True, title=told.title, kept_at=told.kept_at, until=told.until
    )


def _number_of(
    connection: Connection, of_maps: dict[str, MapRow], map_name: str, frame_id: str
) -> int:
    """Number of a frame that an answer shows."""
    row = of_maps.get(map_name) or find_map(connection, map_name)
    number = connection.execute(
        select(frames.c.number).where(
            frames.c.map_number == row.number, frames.c.id == frame_id,
            frames.c.state != FrameState.DELETED,
        )
    ).scalar()  # fmt: skip
    if number is None:
        raise Conflict(
            f"Frame {frame_id} of map {map_name!r} was deleted, and answers that show a deleted "
            "frame are removed, so this one was not kept. Send the query again."
        )
    return int(number)


def _record(connection: Connection, found: StoredResult, asked: list[int]) -> dict[str, Any]:
    """What lists tell of a query: of the record that it left, or would have left.

    The key is left out: records of a key that is revoked are removed, and this one stays.
    """
    answer = found.answer
    left = record_of_answer(connection, asked, answer.query_id, found.at)
    if left is not None:
        own = map_of(connection, left.map_number).name
        return {**asdict(left), "map": own, "maps": answer.maps, "key_id": None}
    # an upload says who asked; a stored frame only who took it
    taken = found.taken if answer.frame is None else QueryOrigin(None, None, None)
    query = AskedQuery(
        answer.maps, found.query, taken.robot, taken.session, None, answer.frame, found.at
    )
    made = record_of(query, answer, answer.milliseconds.get("total", 0.0) / 1e3)
    return {**asdict(made), "maps": answer.maps}


def _listed(row: KeptRow, may_read: Callable[[str], bool]) -> QueryRecord:
    # a version before may have noted less, or more
    known: dict[str, Any] = {one.name: row.record.get(one.name) for one in fields(RecordRow)}
    record = RecordRow(**{**known, "number": row.number, "map_number": 0})
    return query_record(record, row.record["map"], None, None, may_read, kept_record(row))
