"""Signatures, and what changed for searching since a revision of the map."""

from __future__ import annotations

import time
import zlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from sqlalchemy import Connection, func, insert, select, update

from sceneprint.schemas import FrameState
from sceneprint.store.maps import next_revision
from sceneprint.store.records import FrameRow, MapRow
from sceneprint.store.tables import frames, signatures


@dataclass(frozen=True)
class StoredSignature:
    """What a worker made of a frame.

    Parameters
    ----------
    model_id : of the model that made it
    vector : the signature's bytes
    geometry : blob of the artifact
    n_patches, n_pairs : of each level
    """

    model_id: str
    vector: bytes
    geometry: str
    n_patches: Sequence[int]
    n_pairs: Sequence[int]


@dataclass(frozen=True)
class Change:
    """A frame that was indexed or deleted; `vector` is None where it was deleted, or is damaged."""

    number: int
    frame_id: str
    revision: int
    vector: bytes | None
    deleted: bool = False


def index_frame(connection: Connection, frame: FrameRow, made: StoredSignature) -> int:
    """Store a signature and let queries find the frame; returns the map's revision."""
    connection.execute(
        insert(signatures).values(
            frame_number=frame.number, model_id=made.model_id, vector=made.vector,
            checksum=zlib.crc32(made.vector), geometry=made.geometry,
            n_patches=list(made.n_patches), n_pairs=list(made.n_pairs),
        )
    )  # fmt: skip
    revision = next_revision(connection, frame.map_number)
    connection.execute(
        update(frames)
        .where(frames.c.number == frame.number)
        .values(state=FrameState.INDEXED, reason=None, indexed_at=time.time(), revision=revision)
    )
    return revision


def changes_since(
    connection: Connection, row: MapRow, revision: int, limit: int = 256
) -> Iterator[list[Change]]:
    """What was indexed and deleted after a revision, in order, in blocks of at most `limit`."""
    while True:
        found = connection.execute(
            select(frames.c.number, frames.c.id, frames.c.revision, frames.c.state,
                   signatures.c.vector, signatures.c.checksum)
            .outerjoin(
                signatures,
                (signatures.c.frame_number == frames.c.number)
                & (signatures.c.model_id == row.model_id),
            )
            .where(frames.c.map_number == row.number, frames.c.revision > revision)
            .order_by(frames.c.revision)
            .limit(limit)
        ).all()  # fmt: skip
        if not found:
            return
        yield [_change(*one) for one in found]
        revision = found[-1].revision


def _change(
    number: int, frame_id: str, revision: int, state: str, vector: bytes | None,
    checksum: int | None,
) -> Change:  # fmt: skip
    if state == FrameState.DELETED:
        return Change(number, frame_id, revision, None, deleted=True)
    sound = vector is not None and zlib.crc32(vector) == checksum
    return Change(number, frame_id, revision, vector if sound else None)


def count_indexed(connection: Connection, map_number: int, revision: int) -> int:
    """How many frames of a map were indexed after a revision."""
    counted = connection.execute(
        select(func.count()).where(
            frames.c.map_number == map_number,
            frames.c.revision > revision,
            frames.c.state == FrameState.INDEXED,
        )
    )
    return int(counted.scalar_one())


def deleted_since(connection: Connection, map_number: int, revision: int) -> frozenset[int]:
    """Numbers of the frames of a map that were deleted after a revision."""
    found = connection.execute(
        select(frames.c.number).where(
            frames.c.map_number == map_number,
            frames.c.revision > revision,
            frames.c.state == FrameState.DELETED,
        )
    )
    return frozenset(found.scalars())


def geometry_blobs(connection: Connection, numbers: Iterable[int], model_id: str) -> dict[int, str]:
    """Blobs of the geometry artifacts of frames."""
    rows = connection.execute(
        select(signatures.c.frame_number, signatures.c.geometry).where(
            signatures.c.frame_number.in_(list(numbers)), signatures.c.model_id == model_id
        )
    )
    return {row.frame_number: row.geometry for row in rows}


def stored_vector(connection: Connection, number: int, model_id: str) -> bytes | None:
    """The signature of a frame, or None where it has none."""
    found = connection.execute(
        select(signatures.c.vector).where(
            signatures.c.frame_number == number, signatures.c.model_id == model_id
        )
    ).scalar()
    return None if found is None else bytes(found)
