"""Signatures read a few at a time, to be compared with a query and let go.

numbers of frames  --heads-->  what they are  --vectors-->  bytes
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, func, select

from sceneprint.schemas import FrameState
from sceneprint.store.tables import frames, signatures


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
    found = connection.execute(
        select(signatures.c.frame_number, frames.c.map_number, signatures.c.checksum)
        .join(frames, frames.c.number == signatures.c.frame_number)
        .where(
            signatures.c.frame_number == func.any(list(numbers)),
            signatures.c.model_id == model_id,
            frames.c.state == FrameState.INDEXED,
            frames.c.map_number.in_(list(map_numbers)),
        )
        .order_by(signatures.c.frame_number)
    )
    return [Head(*row) for row in found]


def vectors(connection: Connection, numbers: Collection[int], model_id: str) -> dict[int, bytes]:
    """Bytes of signatures, sound or not."""
    found = connection.execute(
        select(signatures.c.frame_number, signatures.c.vector).where(
            signatures.c.frame_number == func.any(list(numbers)),
            signatures.c.model_id == model_id,
        )
    )
    return {row[0]: row[1] for row in found}


def checked(
    connection: Connection, numbers: Collection[int], model_id: str
) -> Sequence[tuple[int, bytes, int]]:
    """Bytes of signatures and what their checksums were: number, bytes, checksum, by number."""
    found = connection.execute(
        select(signatures.c.frame_number, signatures.c.vector, signatures.c.checksum)
        .where(
            signatures.c.frame_number == func.any(list(numbers)),
            signatures.c.model_id == model_id,
        )
        .order_by(signatures.c.frame_number)
    )
    return [(number, vector, checksum) for number, vector, checksum in found]


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


def blocks(
    connection: Connection, map_number: int, model_id: str, rows: int,
    among: NDArray[np.int64] | None = None,
) -> Iterator[Sequence[tuple[int, bytes, int]]]:  # fmt: skip
    """All signatures of a map that can be found, in blocks: number, bytes, checksum, by number.

    Parameters
    ----------
    connection : of a reading transaction
    map_number, model_id : of the map, and of the signatures
    rows : most of a block
    among : numbers of the frames that are wanted, where not all are
    """
    wanted = (
        select(frames.c.number, signatures.c.vector, signatures.c.checksum)
        .join(signatures, signatures.c.frame_number == frames.c.number)
        .where(
            frames.c.map_number == map_number,
            frames.c.state == FrameState.INDEXED,
            signatures.c.model_id == model_id,
        )
        .order_by(frames.c.number)
    )
    if among is not None:
        for start in range(0, len(among), rows):
            some = among[start : start + rows].tolist()
            yield connection.execute(wanted.where(frames.c.number == func.any(some))).all()
        return
    after = -1
    while found := connection.execute(wanted.where(frames.c.number > after).limit(rows)).all():
        yield found
        after = found[-1][0]


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
