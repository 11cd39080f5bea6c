"""A small record of every query: who asked which map, what came of it, and how long it took.

NewRecord, ...  --add_records-->  rows and events in one commit  --list_records-->  RecordRow, ...
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Any

from sqlalchemy import ColumnElement, Connection, delete, func, insert, select, tuple_

from sceneprint.store.tables import among, blocks, events, keys, maps, query_records
from sceneprint_client.api.frames import Kind
from sceneprint_client.api.results import RecordStatus

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
    """

    map: str


@dataclass(frozen=True)
class RecordRow(_Recorded):
    """A record as it is stored; fields as in NewRecord, and its number and that of its map."""

    number: int
    map_number: int


#: Characters of a reason; that of an answer has some 200.
MOST_REASON = 1000
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
    connection.execute(insert(query_records), [_row(one, there[one.map].number) for one in found])
    connection.execute(insert(events), [_event(one) for one in found])
    return len(found)


def _row(one: NewRecord, map_number: int) -> dict[str, Any]:
    row = {each.name: getattr(one, each.name) for each in fields(one) if each.name != "map"}
    reason = one.reason.replace("\0", "")[:MOST_REASON]
    return {**row, "map_number": map_number, "reason": reason}


def _event(one: NewRecord) -> dict[str, Any]:
    data: dict[str, Any] = {"query_id": one.id}
    data |= {name: getattr(one, name) for name in _TOLD if getattr(one, name) is not None}
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
        _c.map_number.in_(map_numbers), _c.at.between(at - 3600.0, at + 60.0), _c.id == query_id
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
        own = _c.map_number == number
        newest = select(_c.at, _c.number).where(own).order_by(_c.at.desc(), _c.number.desc())
        oldest = select(_c.number).where(own).order_by(_c.at, _c.number)
        first = connection.execute(oldest.limit(1)).scalar()
        last = connection.execute(newest.limit(1)).first()
        # numbers are given to the records of all maps: this one has no more than lie between
        if first is None or last is None or last.number - first < kept:
            continue
        beyond = connection.execute(newest.offset(kept).limit(1)).first()
        if beyond is None:
            continue
        spent = oldest.where(tuple_(_c.at, _c.number) <= (beyond.at, beyond.number))
        found += connection.execute(spent.limit(limit - len(found))).scalars()
        if len(found) >= limit:
            break
    return found


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
