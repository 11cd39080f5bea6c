"""Rows of queries: searched maps, sender, outcome, and stored answer.

NewQuery, ...  --add_queries-->  rows and events in one commit  --list_queries-->  QueryRow, ...
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Any

from sqlalchemy import (
    ColumnElement,
    Connection,
    delete,
    func,
    insert,
    literal_column,
    or_,
    select,
    tuple_,
    update,
)

from sceneprint.store.frames import not_purged
from sceneprint.store.tables import (
    among,
    events,
    frames,
    keys,
    maps,
    queries,
    rows_among,
)
from sceneprint_client.api import FrameState
from sceneprint_client.api.frames import Kind
from sceneprint_client.api.results import RecordStatus

_c = queries.c
#: Maximum length of `reason`, characters.
MOST_REASON = 1000


@dataclass(frozen=True)
class _Query:
    id: str
    at: float
    map: str
    maps: Sequence[str] | None
    robot: str | None
    session: str | None
    status: RecordStatus
    cause: str | None
    reason: str
    pose_parent: str | None
    pose: Sequence[float] | None
    confidence: float | None
    support: int | None
    alternatives: int
    milliseconds: float
    kind: Kind | None
    frame_map: str | None
    frame_id: str | None


@dataclass(frozen=True)
class NewQuery(_Query):
    """A query to store, answered or failed.

    Parameters
    ----------
    at : time of arrival, seconds since 1970
    map : name of the map to which the row belongs
    maps : names of all searched maps; None if only `map` was searched
    robot, session : sender and run; None if unknown
    status, cause, reason : values of the answer; or `failed`, the type and the text of the error
    pose_parent, pose : parent frame, and x, y, z, qx, qy, qz, qw of T_parent_query; None without a
        pose
    confidence : confidence of that pose, or of the best alternative
    alternatives : number of other poses that the evidence supports
    kind : kind of the query frame; None if it was not decoded
    frame_map, frame_id : map and id of a stored query frame; None for an upload
    key_id : id of the key of the request
    listed : whether lists and events report the query
    bytes : size of the stored answer; 0 if it is not stored
    shown : frame numbers in the answer
    """

    key_id: str | None
    listed: bool
    bytes: int = 0
    shown: Sequence[int] = ()


@dataclass(frozen=True)
class QueryRow(_Query):
    """A stored query; see NewQuery for the other fields.

    Parameters
    ----------
    key : name of the key; None without a key or after its revocation
    bytes : size of the stored answer; 0 if it is not stored
    kept_at : time from which the answer is permanent; None if it expires
    title : title of a permanent answer
    """

    number: int
    key: str | None
    bytes: int
    kept_at: float | None
    title: str | None

    @property
    def searched(self) -> Sequence[str]:
        """Names of all searched maps."""
        return [self.map] if self.maps is None else self.maps


#: Statement that selects rows without their answers.
_ROW = select(
    *(_c[member.name] for member in fields(QueryRow) if member.name not in ("map", "key")),
    select(maps.c.name).where(maps.c.number == _c.map_number).scalar_subquery().label("map"),
    select(keys.c.name).where(keys.c.id == _c.key_id).scalar_subquery().label("key"),
)
#: Condition with a literal value: planners do not match bound values to a partial index.
_STORED: ColumnElement[bool] = literal_column("bytes > 0")
#: Kind of the event that reports a query.
EVENT = "query.answered"
_REPORTED = ("status", "robot", "session", "cause", "support", "milliseconds")


def add_queries(connection: Connection, new: Sequence[NewQuery]) -> None:
    """Store queries, and an event for each listed query.

    Queries whose map has been deleted or replaced since their arrival are ignored.
    """
    names = sorted({query.map for query in new})
    statement = select(maps.c.number, maps.c.name, maps.c.created_at).where(maps.c.name.in_(names))
    existing = {row.name: row for row in connection.execute(statement)}
    valid = [
        query
        for query in new
        if query.map in existing and existing[query.map].created_at <= query.at
    ]
    if not valid:
        return
    connection.execute(
        insert(queries), [_values(query, existing[query.map].number) for query in valid]
    )
    if reported := [_event(query) for query in valid if query.listed]:
        connection.execute(insert(events), reported)


def _values(query: NewQuery, map_number: int) -> dict[str, Any]:
    row = {each.name: getattr(query, each.name) for each in fields(query) if each.name != "map"}
    return row | {
        "map_number": map_number,
        "reason": query.reason.replace("\0", "")[:MOST_REASON],
        "shown": sorted(set(query.shown)) if query.bytes else None,
    }


def _event(query: NewQuery) -> dict[str, Any]:
    """Return the columns of the event that reports a query."""
    data: dict[str, Any] = {"query_id": query.id}
    data |= {name: getattr(query, name) for name in _REPORTED if getattr(query, name) is not None}
    if query.pose is not None:
        x, y, z, qx, qy, qz, qw = query.pose
        data["pose"] = {
            "parent_frame": query.pose_parent,
            "translation": {"x": x, "y": y, "z": z},
            "rotation": {"x": qx, "y": qy, "z": qz, "w": qw},
        }
    own = query.frame_id if query.frame_map == query.map else None
    # the time of the event, not of the query, because events are sorted by time
    return {
        "at": time.time(), "kind": EVENT, "map": query.map, "frame_id": own, "job_id": None,
        "data": data,
    }  # fmt: skip


@dataclass(frozen=True)
class WantedQueries:
    """Conditions on queries.

    Parameters
    ----------
    map_numbers : numbers of the selected maps; None selects all maps
    statuses : statuses, one of which must match; empty matches all
    robot : sender; None matches all
    since, until : half-open interval of the time of arrival, seconds since 1970
    kept : whether only queries with permanent answers match
    """

    map_numbers: tuple[int, ...] | None = None
    statuses: tuple[str, ...] = ()
    robot: str | None = None
    since: float | None = None
    until: float | None = None
    kept: bool = False


def list_queries(
    connection: Connection, criteria: WantedQueries, before: tuple[float, int] | None, limit: int
) -> list[QueryRow]:
    """Return queries, newest first.

    Parameters
    ----------
    before : time and number of the last row of the previous page
    limit : maximum number of queries
    """
    statement = _ROW.where(*_conditions(criteria))
    if before is not None:
        statement = statement.where(tuple_(_c.at, _c.number) < before)
    statement = statement.order_by(_c.at.desc(), _c.number.desc()).limit(limit)
    return [QueryRow(**row) for row in connection.execute(statement).mappings()]


def _conditions(criteria: WantedQueries) -> Iterator[ColumnElement[bool]]:
    yield _c.kept_at.is_not(None) if criteria.kept else or_(_c.listed, _c.kept_at.is_not(None))
    numbers = criteria.map_numbers
    if numbers is not None:
        # "+ 0" rules out the indexes of maps, since the index of robots selects fewer rows
        own = _c.map_number if criteria.robot is None else _c.map_number + 0
        yield own == numbers[0] if len(numbers) == 1 else own.in_(numbers)
    if criteria.statuses:
        yield _c.status.in_(criteria.statuses)
    if criteria.robot is not None:
        yield _c.robot == criteria.robot
    if criteria.since is not None:
        yield _c.at >= criteria.since
    if criteria.until is not None:
        yield _c.at < criteria.until


def count_statuses(
    connection: Connection, since: float, map_number: int | None = None
) -> dict[int, dict[str, int]]:
    """Count the listed queries of a map, or of all maps, since a time by map number and status."""
    statement = select(_c.map_number, _c.status, func.count().label("n"))
    statement = statement.where(_c.listed, _c.at >= since).group_by(_c.map_number, _c.status)
    if map_number is not None:
        statement = statement.where(_c.map_number == map_number)
    counts: dict[int, dict[str, int]] = {}
    for row in connection.execute(statement):
        counts.setdefault(row.map_number, {})[row.status] = row.n
    return counts


def find_query(connection: Connection, query_id: str) -> QueryRow | None:
    """Return a query by id; None if it does not exist."""
    row = connection.execute(_ROW.where(_c.id == query_id)).mappings().first()
    return None if row is None else QueryRow(**row)


def read_permanent_answer(connection: Connection, number: int) -> bytes | None:
    """Return the permanent answer to a query; None if it is not permanent."""
    answer: bytes | None = connection.execute(select(_c.answer).where(_c.number == number)).scalar()
    return answer


def is_current(connection: Connection, row: QueryRow) -> bool:
    """Return whether the searched maps and the stored query frame, if any, still exist."""
    names = set(row.searched)
    statement = select(maps.c.name).where(maps.c.name.in_(names), maps.c.created_at <= row.at)
    if len(connection.execute(statement).all()) < len(names):
        return False
    if row.frame_id is None:
        return True
    own = (
        select(frames.c.number)
        .join(maps, maps.c.number == frames.c.map_number)
        .where(
            maps.c.name == row.frame_map, frames.c.id == row.frame_id,
            frames.c.state != FrameState.DELETED,
        )
    )  # fmt: skip
    number = connection.execute(own).scalar()
    shown = connection.execute(select(_c.shown).where(_c.number == row.number)).scalar()
    return number is not None and number in (shown or [])  # the id may belong to another frame now


def keep_answer(connection: Connection, number: int, data: bytes, at: float) -> bool:
    """Make an answer permanent by storing it in the database; return False if it has expired."""
    own = update(queries).where(_c.number == number, _STORED)
    return connection.execute(own.values(answer=data, kept_at=at)).rowcount == 1


def set_title(connection: Connection, number: int, title: str | None) -> None:
    """Set the title of a permanent answer."""
    connection.execute(update(queries).where(_c.number == number).values(title=title))


def release_answer(connection: Connection, number: int) -> None:
    """Make a permanent answer expire again."""
    expired = {"answer": None, "kept_at": None, "title": None}
    connection.execute(update(queries).where(_c.number == number).values(expired))


def count_kept(connection: Connection, map_name: str) -> tuple[int, int]:
    """Return the number of permanent answers of a map, and their total bytes over all maps."""
    counts = func.count(), func.coalesce(func.sum(_c.bytes), 0)
    statement = select(*counts).where(_c.kept_at.is_not(None))
    of_map = select(maps.c.number).where(maps.c.name == map_name).scalar_subquery()
    count = connection.execute(statement.where(_c.map_number == of_map)).one()[0]
    return int(count), int(connection.execute(statement).one()[1])


# Removal of expired and surplus queries, of the oldest answers, and of answers with deleted frames.


def old_queries(connection: Connection, before: float, limit: int) -> list[int]:
    """Return the row numbers of the oldest queries before a time, except permanent answers."""
    spent = select(_c.number).where(_c.at < before, _c.kept_at.is_(None))
    return list(connection.execute(spent.order_by(_c.at, _c.number).limit(limit)).scalars())


def surplus_queries(connection: Connection, most: int, limit: int) -> list[int]:
    """Return the row numbers of the oldest queries of maps with more than `most` queries."""
    span = connection.execute(select(func.max(_c.number) - func.min(_c.number))).scalar()
    if (span or 0) < most:  # usual case; avoids a count
        return []
    counts = select(_c.map_number, func.count()).group_by(_c.map_number)
    numbers: list[int] = []
    for map_number, count in connection.execute(counts.having(func.count() > most)).all():
        own = select(_c.number).where(_c.map_number == map_number, _c.kept_at.is_(None))
        least = min(count - most, limit - len(numbers))
        numbers += connection.execute(own.order_by(_c.at, _c.number).limit(least)).scalars()
    return numbers


def queries_of_map(connection: Connection, map_number: int, limit: int) -> list[int]:
    """Return the row numbers of up to `limit` queries of a map."""
    own = select(_c.number).where(_c.map_number == map_number).limit(limit)
    return list(connection.execute(own).scalars())


def remove_queries(connection: Connection, numbers: Sequence[int]) -> list[str]:
    """Remove up to a few hundred queries; return the ids of those with a stored answer."""
    own = among(connection, _c.number, numbers)
    stored = list(connection.execute(select(_c.id).where(own, _STORED)).scalars())
    connection.execute(delete(queries).where(own))
    return stored


def stored_bytes(connection: Connection) -> int:
    """Return the total size, in bytes, of stored answers."""
    total = connection.execute(select(func.sum(_c.bytes)).where(_STORED)).scalar()
    return int(total or 0)


def oldest_answers(connection: Connection, limit: int) -> list[tuple[int, int]]:
    """Return row number and size, in bytes, of the oldest answers, except permanent answers."""
    statement = select(_c.number, _c.bytes).where(_STORED, _c.kept_at.is_(None))
    rows = connection.execute(statement.order_by(_c.at, _c.number).limit(limit))
    return [(row.number, row.bytes) for row in rows]


def shown_frames(connection: Connection, after: int, limit: int) -> list[tuple[int, list[int]]]:
    """Return the row number and frame numbers of the next stored answers after row `after`."""
    statement = select(_c.number, _c.shown).where(_STORED, _c.number > after)
    rows = connection.execute(statement.order_by(_c.number).limit(limit))
    return [(row.number, row.shown or []) for row in rows]


def unpurged_frames(connection: Connection, numbers: set[int]) -> set[int]:
    """Return the numbers of the frames among `numbers` that exist or can be restored."""
    statement = select(frames.c.number).where(not_purged())
    return {row.number for row in rows_among(connection, statement, frames.c.number, numbers)}


def drop_answers(connection: Connection, numbers: Sequence[int]) -> list[str]:
    """Remove up to a few hundred answers, and their queries if unlisted; return the query ids."""
    own = among(connection, _c.number, numbers)
    stored = list(connection.execute(select(_c.id).where(own, _STORED)).scalars())
    connection.execute(delete(queries).where(own, ~_c.listed))
    removed = {"answer": None, "bytes": 0, "shown": None, "kept_at": None, "title": None}
    connection.execute(update(queries).where(own).values(removed))
    return stored


def stored_answer_ids(connection: Connection, query_ids: Sequence[str]) -> set[str]:
    """Return the query ids, among up to a thousand, whose answers are stored in files."""
    statement = select(_c.id).where(_c.id.in_(query_ids), _STORED, _c.kept_at.is_(None))
    return set(connection.execute(statement).scalars())
