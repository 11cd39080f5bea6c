"""Signatures read from PostgreSQL a few at a time, to be compared with a query and let go.

numbers of frames  --heads-->  what they are  --vectors-->  bytes

By the driver itself, as bytes: as text, which SQLAlchemy asks for, they take three times as long.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, func, select

from sceneprint.schemas import FrameState
from sceneprint.store.tables import frames

#: Number of a frame, its signature, and the CRC-32 that it had when it was stored.
Vector = tuple[int, bytes, int]


@dataclass(frozen=True)
class Head:
    """A signature without its bytes: whose it is, and the CRC-32 of the bytes."""

    number: int
    map_number: int
    checksum: int


def heads(
    connection: Connection, numbers: Collection[int], map_numbers: Collection[int], model_id: str
) -> list[Head]:
    """Signatures of those of some frames that can be found in the maps, by number."""
    # one table after the other, by nothing but its key, of its own type: of a join, or a state, of
    # tables that it has no figures of yet, the planner makes a hundred times the work
    wanted = set(map_numbers)
    of = {
        number: of_map
        for number, of_map, state in _read(
            connection,
            "SELECT number, map_number, state FROM frames WHERE number = ANY(%s::bigint[])",
            (list(numbers),),
        )
        if of_map in wanted and state == FrameState.INDEXED
    }
    found = _read(
        connection,
        "SELECT frame_number, checksum FROM signatures "
        "WHERE frame_number = ANY(%s::bigint[]) AND model_id = %s ORDER BY frame_number",
        (list(of), model_id),
    )
    return [Head(number, of[number], checksum) for number, checksum in found]


def vectors(connection: Connection, numbers: Collection[int], model_id: str) -> list[Vector]:
    """Signatures of frames by number, sound or not."""
    return _read(
        connection,
        "SELECT frame_number, vector, checksum FROM signatures "
        "WHERE frame_number = ANY(%s::bigint[]) AND model_id = %s ORDER BY frame_number",
        (list(numbers), model_id),
    )


def blocks(
    connection: Connection, map_number: int, model_id: str, rows: int,
    among: NDArray[np.int64] | None = None,
) -> Iterator[list[Vector]]:  # fmt: skip
    """All signatures of a map that can be found, in blocks, by number.

    Parameters
    ----------
    connection : of a reading transaction
    map_number, model_id : of the map, and of the signatures
    rows : most of a block
    among : numbers of the frames that are wanted, where not all are
    """
    if among is not None:
        for start in range(0, len(among), rows):
            there = heads(connection, among[start : start + rows].tolist(), [map_number], model_id)
            yield vectors(connection, [head.number for head in there], model_id)
        return
    after = -1
    listed = (
        select(frames.c.number)
        .where(frames.c.map_number == map_number, frames.c.state == FrameState.INDEXED)
        .order_by(frames.c.number)
        .limit(rows)
    )
    while numbers := list(connection.execute(listed.where(frames.c.number > after)).scalars()):
        yield vectors(connection, numbers, model_id)
        after = numbers[-1]


def at_places(
    connection: Connection, map_numbers: Collection[int], places: Collection[int]
) -> list[int]:
    """Frames at some places of all that can be found in maps, one map after the other."""
    order = func.row_number().over(order_by=(frames.c.map_number, frames.c.number)) - 1
    listed = (
        select(frames.c.number, order.label("place"))
        .where(frames.c.map_number.in_(list(map_numbers)), frames.c.state == FrameState.INDEXED)
        .subquery()
    )
    chosen = select(listed.c.number).where(listed.c.place == func.any(list(places)))
    return list(connection.execute(chosen).scalars())


def sizes(connection: Connection, map_numbers: Collection[int]) -> dict[int, int]:
    """How many frames of each map can be found."""
    found = connection.execute(
        select(frames.c.map_number, func.count())
        .where(frames.c.map_number.in_(list(map_numbers)), frames.c.state == FrameState.INDEXED)
        .group_by(frames.c.map_number)
    )
    counted = {row[0]: row[1] for row in found}
    return {number: counted.get(number, 0) for number in map_numbers}


def count_newer(connection: Connection, map_number: int, revision: int, most: int) -> int:
    """How many frames of a map were indexed after a revision, counted no farther than `most`."""
    some = (
        select(frames.c.number)
        .where(
            frames.c.map_number == map_number,
            frames.c.revision > revision,
            frames.c.state == FrameState.INDEXED,
        )
        .limit(most)
    )
    return int(connection.execute(select(func.count()).select_from(some.subquery())).scalar_one())


def _read(connection: Connection, statement: str, values: Sequence[object]) -> list[Any]:
    driver: Any = connection.connection.driver_connection
    with driver.cursor(binary=True) as cursor:
        found: list[Any] = cursor.execute(statement, values).fetchall()
        return found
