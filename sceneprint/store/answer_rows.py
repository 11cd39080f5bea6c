"""Rows of answers that are kept until they are released, and which of them have to go.

NewKeptAnswer  --keep_answer-->  rows  --find_answer | list_answers-->  KeptRow, ...
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import ColumnElement, Connection, delete, func, insert, or_, select, tuple_, update

from sceneprint.store.query_records import WantedRecords
from sceneprint.store.tables import (
    frames,
    kept_answer_frames,
    kept_answer_maps,
    kept_answers,
    now,
)
from sceneprint_client.api import FrameState

_c = kept_answers.c


@dataclass(frozen=True)
class KeptRow:
    """A kept answer; fields as in the table."""

    number: int
    id: str
    blob: str
    bytes: int
    title: str | None
    kept_at: float
    until: float | None
    at: float
    status: str
    robot: str | None
    record: dict[str, Any]


@dataclass(frozen=True)
class NewKeptAnswer:
    """An answer to be kept.

    Parameters
    ----------
    id, blob, bytes, at, status, robot, record : see the table
    map_numbers : of the maps that were asked
    frame_numbers : of the frames that it shows
    """

    id: str
    blob: str
    bytes: int
    at: float
    status: str
    robot: str | None
    record: dict[str, Any]
    map_numbers: Sequence[int]
    frame_numbers: Sequence[int]


def keep_answer(
    connection: Connection, new: NewKeptAnswer, title: str | None, until: float | None
) -> KeptRow:
    """Keep an answer that is not kept yet."""
    values = {
        "id": new.id, "blob": new.blob, "bytes": new.bytes, "at": new.at, "status": new.status,
        "robot": new.robot, "record": new.record, "title": title, "until": until,
        "kept_at": now(connection),
    }  # fmt: skip
    made = insert(kept_answers).values(**values).returning(kept_answers)
    row = KeptRow(**connection.execute(made).mappings().one())
    for table, column, numbers in (
        (kept_answer_maps, "map_number", new.map_numbers),
        (kept_answer_frames, "frame_number", new.frame_numbers),
    ):
        links = [{"kept_number": row.number, column: one} for one in sorted(set(numbers))]
        if links:
            connection.execute(insert(table), links)
    return row


def edit_kept_answer(
    connection: Connection, row: KeptRow, title: str | None, until: float | None
) -> KeptRow:
    """Give a kept answer another title and another end."""
    own = update(kept_answers).where(_c.number == row.number).values(title=title, until=until)
    return KeptRow(**connection.execute(own.returning(kept_answers)).mappings().one())


def find_answer(connection: Connection, query_id: str) -> KeptRow | None:
    """The kept answer of an id, unless its time is over."""
    asked = select(kept_answers).where(_c.id == query_id, _standing(connection))
    row = connection.execute(asked).mappings().first()
    return None if row is None else KeptRow(**row)


def expired_answer(connection: Connection, query_id: str) -> list[int]:
    """Number of the kept answer of an id whose time is over, if nobody has removed it yet."""
    asked = select(_c.number).where(_c.id == query_id, ~_standing(connection))
    return list(connection.execute(asked).scalars())


def kept_among(connection: Connection, query_ids: Collection[str]) -> dict[str, KeptRow]:
    """Those of some answers that are kept, by their ids."""
    asked = select(kept_answers).where(_c.id.in_(query_ids), _standing(connection))
    return {row["id"]: KeptRow(**row) for row in connection.execute(asked).mappings()}


def count_kept(connection: Connection, map_number: int) -> tuple[int, int]:
    """How many kept answers a map has, and bytes of them."""
    asked = (
        select(func.count(), func.coalesce(func.sum(_c.bytes), 0))
        .join(kept_answer_maps, kept_answer_maps.c.kept_number == _c.number)
        .where(kept_answer_maps.c.map_number == map_number)
    )
    count, size = connection.execute(asked).one()
    return int(count), int(size)


def list_answers(
    connection: Connection, wanted: WantedRecords, named: int | None,
    before: tuple[float, int] | None, limit: int,
) -> list[KeptRow]:  # fmt: skip
    """Kept answers, those of the newest queries first.

    Parameters
    ----------
    connection : of the database
    wanted : which; `map_numbers`: only those that were asked of no other map
    named : number of a map that must have been asked; None: of any
    before : time and number of the answer that the page before ended with
    limit : at most so many
    """
    asked = select(kept_answers).where(_standing(connection), *_conditions(wanted, named))
    if before is not None:
        asked = asked.where(tuple_(_c.at, _c.number) < before)
    asked = asked.order_by(_c.at.desc(), _c.number.desc()).limit(limit)
    return [KeptRow(**row) for row in connection.execute(asked).mappings()]


def _conditions(wanted: WantedRecords, named: int | None) -> Iterator[ColumnElement[bool]]:
    links = select(kept_answer_maps.c.kept_number)
    if named is not None:
        yield _c.number.in_(links.where(kept_answer_maps.c.map_number == named))
    if wanted.map_numbers is not None:
        others = kept_answer_maps.c.map_number.not_in(wanted.map_numbers)
        yield _c.number.not_in(links.where(others))
    if wanted.statuses:
        yield _c.status.in_(wanted.statuses)
    if wanted.robot is not None:
        yield _c.robot == wanted.robot
    if wanted.since is not None:
        yield _c.at >= wanted.since
    if wanted.until is not None:
        yield _c.at < wanted.until


def _standing(connection: Connection) -> ColumnElement[bool]:
    return or_(_c.until.is_(None), _c.until > now(connection))


def spent_answers(connection: Connection, limit: int) -> list[int]:
    """Numbers of kept answers whose time is over, and of those that show a frame which was deleted
    and cannot be restored any more.
    """
    gone = (
        select(kept_answer_frames.c.kept_number)
        .join(frames, frames.c.number == kept_answer_frames.c.frame_number)
        .where(frames.c.state == FrameState.DELETED, frames.c.deletion.is_(None))
    )
    spent = or_(_c.until <= now(connection), _c.number.in_(gone))
    return list(connection.execute(select(_c.number).where(spent).limit(limit)).scalars())


def answers_of_map(connection: Connection, map_number: int) -> list[int]:
    """Numbers of all kept answers that a map was asked for, or that show a frame of it."""
    asked = select(kept_answer_maps.c.kept_number).where(
        kept_answer_maps.c.map_number == map_number
    )
    shown = (
        select(kept_answer_frames.c.kept_number)
        .join(frames, frames.c.number == kept_answer_frames.c.frame_number)
        .where(frames.c.map_number == map_number)
    )
    return list(connection.execute(asked.union(shown)).scalars())


def remove_answers(connection: Connection, numbers: Sequence[int]) -> list[str]:
    """Release some kept answers, a few thousand at most; returns the blobs that they were."""
    blobs = list(connection.execute(select(_c.blob).where(_c.number.in_(numbers))).scalars())
    for table in (kept_answer_maps, kept_answer_frames):
        connection.execute(delete(table).where(table.c.kept_number.in_(numbers)))
    connection.execute(delete(kept_answers).where(_c.number.in_(numbers)))
    return blobs
