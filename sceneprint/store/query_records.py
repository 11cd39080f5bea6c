"""A small record of every query: who asked which map, what came of it, and how long it took.

NewRecord, ...  --add_records-->  rows and events in one commit  --list_records-->  RecordRow, ...
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

from sqlalchemy import ColumnElement, Connection, delete, func, insert, select, tuple_

from sceneprint.store.queue import read_clock
from sceneprint.store.tables import MapRow, among, blocks, events, keys, maps, query_records
from sceneprint_client.api.frames import Kind
from sceneprint_client.api.results import MOST_REASON, RecordStatus

_c = query_records.c


@dataclass(frozen=True)
class _Recorded:
    id: str
    at: float
    maps: Sequence[str] | None
    robot: str | None
    session: str | None
    key_id: str | None
    status: RecordStatus
    cause: str | None
    reason: str
    pose_parent: str | None
    pose: Sequence[float] | None
    support: int | None
    rival_ratio: float | None
    alternatives: int
    milliseconds: float
    kind: Kind | None
    frame_map: str | None
    frame_id: str | None
    kept: bool
    offline: bool = field(default=False, kw_only=True)


@dataclass(frozen=True)
class NewRecord(_Recorded):
    """What came of a query.

    Parameters
    ----------
    id : of its answer
    at : when it came, seconds since 1970
    map : name of the map that the record belongs to
    maps : names of all that were asked; None: of `map` alone
    robot, session : who asked, in which run, as far as that was told
    key_id : of the key that was shown
    status, cause, reason : of the answer; or `failed`, the kind of the error, and its text
    pose_parent, pose : x, y, z, qx, qy, qz, qw of T_parent_query where it was found
    support, rival_ratio : of that pose
    alternatives : how many poses the evidence supports as well
    milliseconds : that it took
    kind : of the frame that was asked for, as far as it was read
    frame_map, frame_id : the stored frame that was asked for
    kept : whether the answer was to be kept
    offline : whether a robot answered it itself, and sent this later
    """

    map: str


@dataclass(frozen=True)
class RecordRow(_Recorded):
    """A record as it is stored; fields as in NewRecord, and its number and that of its map."""

    number: int
    map_number: int


#: Of the event that tells of a query, beside what `_told` adds.
EVENT = "query.answered"
_TOLD = ("status", "robot", "session", "cause", "support", "milliseconds")


def add_records(connection: Connection, records: Sequence[NewRecord]) -> int:
    """Store what came of queries, an event for each; returns how many.

    Those of a map that is gone, or was made anew since the query came, are left out.
    """
    names = sorted({one.map for one in records})
    there = {
        row.name: row
        for row in connection.execute(
            select(maps.c.number, maps.c.name, maps.c.created_at).where(maps.c.name.in_(names))
        )
    }
    found = [
        one for one in records if one.map in there and there[one.map].created_at <= one.at
    ]  # fmt: skip
    if not found:
        return 0
    _insert(connection, [(one, there[one.map].number) for one in found])
    return len(found)


def _insert(connection: Connection, found: Sequence[tuple[NewRecord, int]]) -> None:
    """Store records with the numbers of their maps, an event for each."""
    connection.execute(insert(query_records), [_row(*one) for one in found])
    connection.execute(insert(events), [_event(one) for one, _ in found])


def _row(one: NewRecord, map_number: int) -> dict[str, Any]:
    row = {each.name: getattr(one, each.name) for each in fields(one) if each.name != "map"}
    reason = one.reason.replace("\0", "")[:MOST_REASON]
    return {**row, "map_number": map_number, "reason": reason}


def _event(one: NewRecord) -> dict[str, Any]:
    data: dict[str, Any] = {"query_id": one.id}
    data |= {name: getattr(one, name) for name in _TOLD if getattr(one, name) is not None}
    if one.offline:
        data["offline"] = True
    if one.pose is not None:
        x, y, z, qx, qy, qz, qw = one.pose
        data["pose"] = {
            "parent_frame": one.pose_parent,
            "translation": {"x": x, "y": y, "z": z},
            "rotation": {"x": qx, "y": qy, "z": qz, "w": qw},
        }
    own = one.frame_id if one.frame_map == one.map else None
    # of now, and not of when the query came: events are in the order of their times
    return {
        "at": time.time(), "kind": EVENT, "map": one.map, "frame_id": own, "job_id": None,
        "data": data,
    }  # fmt: skip


# Records that robots send of queries that they answered themselves.


@dataclass(frozen=True)
class OfflineOutcome:
    """What came of records that a robot sent.

    Parameters
    ----------
    received, there, expired : how many; see QueryRecordsAdded
    refused : ids of others, and why
    """

    received: int
    there: int
    expired: int
    refused: dict[str, str]


def add_offline_records(
    connection: Connection, row: MapRow, records: Sequence[NewRecord], kept_s: float, kept: int
) -> OfflineOutcome:
    """Store records that a robot sends, each once, an event for each that is new.

    Parameters
    ----------
    connection : of a transaction that other writers wait for
    row : of the map that they belong to
    records : at most a few hundred, none with the id of another
    kept_s : seconds that records are kept
    kept : how many a map keeps: the oldest beyond go at once, or a robot could fill the disk
    """
    clock = read_clock(connection)
    stored = _stored_offline(connection, row.number, records)
    new, there, expired, refused = [], 0, 0, {}
    for one in records:
        before = stored.get(one.id)
        if before is not None:
            if _is_same(before, one):
                there += 1
            else:
                refused[one.id] = "the map has another record with this id"
        elif one.at < clock - kept_s:
            expired += 1
        elif one.at < row.created_at:
            refused[one.id] = (
                "the query is older than the map: this is another map of that name, or the robot's "
                "clock was wrong"
            )
        else:
            new.append(replace(one, at=min(one.at, clock)))
    if new:
        _insert(connection, [(one, row.number) for one in new])
        remove_records(connection, _surplus(connection, row.number, kept, 2 * len(records)))
    return OfflineOutcome(len(new), there, expired, refused)


def _stored_offline(
    connection: Connection, map_number: int, records: Sequence[NewRecord]
) -> dict[str, RecordRow]:
    """Records of the map that have the ids of some, by these; each way by its index."""
    ids = [one.id for one in records]

    def found(own: ColumnElement[bool]) -> dict[str, RecordRow]:
        asked = select(query_records).where(_c.map_number == map_number, own, _c.id.in_(ids))
        return {row["id"]: RecordRow(**row) for row in connection.execute(asked).mappings()}

    # those that the service answered itself are found by their times, if a robot sends them back
    return found(_c.at.in_([one.at for one in records])) | found(_c.offline)


def _is_same(stored: RecordRow, one: NewRecord) -> bool:
    """Whether a record is stored already with the same content."""
    if stored.at != one.at and not (stored.offline and stored.at < one.at):
        return False  # a time in the future is stored as that of the request
    told = _row(one, stored.map_number)
    return all(
        _plain(getattr(stored, name)) == _plain(value)
        for name, value in told.items()
        if name not in ("at", "key_id", "kept", "offline")
    )


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


@dataclass(frozen=True)
class WantedRecords:
    """Which records somebody asks for, and may see.

    Parameters
    ----------
    map_numbers : only of these maps; None: of all
    statuses : one of these; none: any
    robot : who asked; None: anybody
    since, until : that came at that time or later, and before that one, seconds since 1970
    """

    map_numbers: tuple[int, ...] | None = None
    statuses: tuple[str, ...] = ()
    robot: str | None = None
    since: float | None = None
    until: float | None = None


def list_records(
    connection: Connection, wanted: WantedRecords, before: tuple[float, int] | None, limit: int
) -> list[RecordRow]:
    """Records, the newest first.

    Parameters
    ----------
    connection : of the database
    wanted : which
    before : time and number of the record that the page before ended with
    limit : at most so many
    """
    asked = select(query_records).where(*_conditions(wanted))
    if before is not None:
        asked = asked.where(tuple_(_c.at, _c.number) < before)
    asked = asked.order_by(_c.at.desc(), _c.number.desc()).limit(limit)
    return [RecordRow(**row) for row in connection.execute(asked).mappings()]


def record_of_answer(
    connection: Connection, map_numbers: Sequence[int], query_id: str, at: float
) -> RecordRow | None:
    """The record of an answer, or None where it left none, or it is gone.

    Parameters
    ----------
    connection : of the database
    map_numbers : of the maps that were asked
    query_id : of the answer
    at : when it was given, seconds since 1970: the query came at most an hour before
    """
    asked = select(query_records).where(
        _c.map_number.in_(map_numbers),
        _c.at.between(at - 3600.0, at + 60.0),
        _c.id == query_id,
        ~_c.offline,
    )
    row = connection.execute(asked).mappings().first()
    return None if row is None else RecordRow(**row)


def _conditions(wanted: WantedRecords) -> Iterator[ColumnElement[bool]]:
    numbers = wanted.map_numbers
    if numbers is not None:
        # a sum is in no index: the records of a robot are few, and found by its own
        own = _c.map_number if wanted.robot is None else _c.map_number + 0
        yield own == numbers[0] if len(numbers) == 1 else own.in_(numbers)
    if wanted.statuses:
        yield _c.status.in_(wanted.statuses)
    if wanted.robot is not None:
        yield _c.robot == wanted.robot
    if wanted.since is not None:
        yield _c.at >= wanted.since
    if wanted.until is not None:
        yield _c.at < wanted.until


def names_of(
    connection: Connection, rows: Sequence[RecordRow]
) -> tuple[dict[int, str], dict[str, str]]:
    """Names of the maps of some records by their numbers, and of their keys by their ids."""
    numbers = {one.map_number for one in rows}
    ids = {one.key_id for one in rows if one.key_id is not None}
    of_maps = connection.execute(
        select(maps.c.number, maps.c.name).where(maps.c.number.in_(numbers))
    )
    of_keys = connection.execute(select(keys.c.id, keys.c.name).where(keys.c.id.in_(ids)))
    return {row.number: row.name for row in of_maps}, {row.id: row.name for row in of_keys}


# Which records go: those that are old, those that a map has too many of, and those of keys that
# are gone.


def old_records(connection: Connection, before: float, limit: int) -> list[int]:
    """Numbers of the oldest records that came before a time."""
    asked = select(_c.number).where(_c.at < before).order_by(_c.at, _c.number).limit(limit)
    return list(connection.execute(asked).scalars())


def surplus_records(connection: Connection, kept: int, limit: int) -> list[int]:
    """Numbers of the oldest records of maps that have more than so many."""
    found: list[int] = []
    for number in connection.execute(select(maps.c.number)).scalars().all():
        found += _surplus(connection, number, kept, limit - len(found))
        if len(found) >= limit:
            break
    return found


def _surplus(connection: Connection, map_number: int, kept: int, limit: int) -> list[int]:
    """Numbers of the oldest records of a map that has more than so many."""
    own = _c.map_number == map_number
    newest = select(_c.at, _c.number).where(own).order_by(_c.at.desc(), _c.number.desc())
    oldest = select(_c.number).where(own).order_by(_c.at, _c.number)
    first = connection.execute(oldest.limit(1)).scalar()
    last = connection.execute(newest.limit(1)).first()
    if first is None or last is None:
        return []
    # numbers are given to the records of all maps, in the order of their times but for those that
    # robots sent later: without these a map has no more than lie between
    late = connection.execute(select(_c.number).where(own, _c.offline).limit(1)).first()
    if late is None and last.number - first < kept:
        return []
    beyond = connection.execute(newest.offset(kept).limit(1)).first()
    if beyond is None:
        return []
    spent = oldest.where(tuple_(_c.at, _c.number) <= (beyond.at, beyond.number))
    return list(connection.execute(spent.limit(limit)).scalars())


def records_of_map(connection: Connection, map_number: int, limit: int) -> list[int]:
    """Numbers of some records of a map."""
    asked = select(_c.number).where(_c.map_number == map_number).limit(limit)
    return list(connection.execute(asked).scalars())


def records_of_former_keys(connection: Connection, limit: int) -> list[int]:
    """Numbers of some records of queries that were asked with keys that are gone."""
    there = set(connection.execute(select(keys.c.id)).scalars())
    of_key = ""
    while True:  # each key is looked up once, however many records it has
        asked = select(func.min(_c.key_id)).where(_c.key_id > of_key)
        found: str | None = connection.execute(asked).scalar()
        if found is None:
            return []
        of_key = found
        if of_key not in there:
            own = select(_c.number).where(_c.key_id == of_key).limit(limit)
            return list(connection.execute(own).scalars())


def remove_records(connection: Connection, numbers: Sequence[int]) -> None:
    """Remove records."""
    for some in blocks(numbers):
        connection.execute(delete(query_records).where(among(connection, _c.number, some)))
