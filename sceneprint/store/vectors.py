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
from sceneprint.store.tables import frames, signatures

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
    # one table after the other: of a join of tables it has no figures of yet the planner makes
    # a hundred times the work
    there = connection.execute(
        select(frames.c.number, frames.c.map_number).where(
            frames.c.number == func.any(list(numbers)), frames.c.state == FrameState.INDEXED
        )
    )
    wanted = set(map_numbers)
    of = {number: of_map for number, of_map in there if of_map in wanted}
    found = connection.execute(
        select(signatures.c.frame_number, signatures.c.checksum).where(
            signatures.c.frame_number == func.any(list(of)), signatures.c.model_id == model_id
        )
    )
    return sorted(
        (Head(number, of[number], checksum) for number, checksum in found),
        key=lambda head: head.number,
    )


def vectors(connection: Connection, numbers: Collection[int], model_id: str) -> list[Vector]:
    """Signatures of frames by number, sound or not."""
    return _read(
        connection,
        "SELECT frame_number, vector, checksum FROM signatures "
        "WHERE frame_number = ANY(%s) AND model_id = %s ORDER BY frame_number",
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
